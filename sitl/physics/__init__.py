"""The vehicle: airframes, rigid body, motors, sensors, the ground."""
