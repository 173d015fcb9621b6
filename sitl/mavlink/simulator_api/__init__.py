"""The plant as a process of its own: PX4's simulator API, with both ends of the link, and ArduPilot's JSON protocol."""
