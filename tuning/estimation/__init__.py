"""Estimators of gains: VRFT, its SISO form, and the methods that it is compared with."""
