"""Campaigns: Monte Carlo flights of a varied vehicle with several gain sets, on all cores or many machines."""
