"""PX4's simulator API: the plant as a separate process, and the autopilot's end of the link."""
