"""Flight logs: formats, readers, checks, and what a log contains."""
