"""Experiments: the initial ones, and the one that would decide."""
