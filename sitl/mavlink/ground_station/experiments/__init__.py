"""Excitation experiments on a vehicle over MAVLink: our module, stock PX4, stock ArduCopter."""
