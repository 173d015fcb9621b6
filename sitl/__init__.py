"""Software in the loop: airframes, plant, sensors, autopilot host, faults, flights, MAVLink, campaigns and studies.

Apart from `sitl.studies`, nothing here knows how gains are tuned or how the C++ is rendered.
"""
