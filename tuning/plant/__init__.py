"""What an experiment says of the vehicle: frequency response, inertia, identified model."""
