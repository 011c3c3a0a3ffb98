"""Servos, stages, spindles, links and conveyors that share no code with `plants`."""
