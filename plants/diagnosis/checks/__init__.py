"""Faults of measurements, before anything is fitted to them."""
