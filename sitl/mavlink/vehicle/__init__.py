"""The vehicle's MAVLink side: autopilot host, commands, parameters, setpoints, telemetry, ground stations."""
