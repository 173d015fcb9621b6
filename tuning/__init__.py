"""From signals to gains: reference models, VRFT, log readers, the gains file.

This room knows nothing of C++, of MAVLink or of the plant.
"""
