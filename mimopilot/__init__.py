"""From one flight log to tuned, tested C++ for a multirotor's attitude controller."""
