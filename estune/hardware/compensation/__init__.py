"""Compensations that the loop runs beside the PIDF: settings, in Python, and as C for firmware."""
