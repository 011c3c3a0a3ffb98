"""Models that are compared with records, and their free parameters."""
