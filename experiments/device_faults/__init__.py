"""Faults of the devices next to a machine: a serial board, an ODrive with a gauge on CAN."""
