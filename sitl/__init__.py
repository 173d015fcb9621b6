"""The bench: airframes, plant, sensors, allocation, scenarios, the autopilot host and MAVLink.

This room knows neither how gains were found nor how C++ is rendered; only `sitl.studies` calls tuning.
"""
