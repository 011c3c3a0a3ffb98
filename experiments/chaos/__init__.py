"""Chaos test of the link, the daemon and the emergency stop."""
