"""Logs of a vehicle over its link: list, download, resume, verify."""
