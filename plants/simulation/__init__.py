"""Simulated trials: compiled loop, batches, a plant as a rig."""
