"""Faults: their kinds, and how they act on the plant, the link and the autopilot."""
