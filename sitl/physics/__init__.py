"""The simulated vehicle: airframes, rigid body, motors, sensors and ground contact."""
