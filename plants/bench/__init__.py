"""Reels whose far end moves: the force felt there, several reels that hold one body.

felt_force          the test of `estune bench`: hysteresis, bandwidth, the force felt
cable_platform      equations of reels that hold one body, in real time; the benches of the test
moving_cable_end    `plants.simulate_moving`, a trial while the cable's length changes
"""
