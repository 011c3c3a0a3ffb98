"""Simulated demonstrations of the paper's compensations and workspace boundary."""
