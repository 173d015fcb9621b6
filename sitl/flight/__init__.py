"""Flights in process: scenarios, the simulator, logs, figures of merit."""
