"""Trials and unsafe trials that tuners need under measurement noise."""
