"""Tuners compared on one plant or rig."""
