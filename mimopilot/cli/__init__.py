"""The command line, one file for each group of commands: a thin layer over the API."""
