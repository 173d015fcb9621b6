"""From a log to a complete gain set."""
