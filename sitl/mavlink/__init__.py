"""The MAVLink side of the bench: PX4's simulator API, the autopilot host and its ground link."""
