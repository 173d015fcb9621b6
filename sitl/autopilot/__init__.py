"""The autopilot around the generated controller: altitude control, flight modes, setpoints, excitation."""
