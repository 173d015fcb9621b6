"""In-process flights: scenarios, the simulator, logs, performance figures."""
