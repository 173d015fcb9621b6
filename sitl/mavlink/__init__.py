"""MAVLink: the wire, the simulated vehicle, the ground station, PX4's simulator API."""
