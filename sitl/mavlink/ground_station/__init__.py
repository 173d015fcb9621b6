"""The ground station: parameters up and down, and the experiment on a vehicle in the air."""
