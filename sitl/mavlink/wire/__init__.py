"""Bytes and numbers of MAVLink 2, for both ends of a link."""
