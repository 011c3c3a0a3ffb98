"""Residual of the base model, and its localisation."""
