"""The ground station: reads and writes parameters, and runs the excitation experiment on a flying vehicle."""
