"""From logs to gains: log readers, reference models, VRFT, certificates, the gains file.

Nothing here depends on C++, MAVLink or the simulation.
"""
