"""Matching: several reels tuned to the same cost, so that they are equally transparent.

The paper's conclusion: reels differ in their mechanics, so a production needs a similar value of
the cost (35) on all of them, not the least cost of each. Each reel is tuned, a target that all can
reach is chosen, and each reel is detuned along one path until its cost equals the target.
"""
