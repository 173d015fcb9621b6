"""MAVLink: wire format, PX4's simulator API, the simulated vehicle, the ground station."""

from mimopilot.common.extras import VEHICLE

VEHICLE.need()
