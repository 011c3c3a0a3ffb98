"""Costs of a daemon, a journal, a sweep and a diagnosis, and how they grow."""
