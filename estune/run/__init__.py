"""One tuning run: its plan, loop, journal and result."""
