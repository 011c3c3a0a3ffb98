"""Drivers of hardware that people own: a serial board, an ODrive by CAN, gauges beside a drive."""
