"""Diagnosis as text, figures, page and JSON."""
