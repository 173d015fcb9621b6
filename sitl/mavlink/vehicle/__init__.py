"""The simulated vehicle as ground stations see it."""
