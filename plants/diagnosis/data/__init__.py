"""Measured records as they are read: their columns, noise and floor."""
