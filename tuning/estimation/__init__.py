"""Estimators of gains: VRFT, its SISO form, and the methods it is compared with."""
