"""The autopilot around the generated controller: estimate, altitude, flight modes, control allocation."""
