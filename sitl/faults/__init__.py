"""Faults: their kinds, and how they act on the plant and on the autopilot."""
