"""Campaigns: many flights of a vehicle that varies, under several gain sets, on all cores or many machines."""
