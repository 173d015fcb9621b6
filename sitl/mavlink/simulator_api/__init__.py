"""PX4's simulator API: the plant as a process of its own, and the autopilot's end of it."""
