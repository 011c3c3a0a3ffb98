"""Reels tuned to one and the same cost, so that they are equally transparent.

The paper's conclusion: as each reel has its own mechanics, the least cost on each is not the goal;
a similar value of the cost (35) on all of them is, within a quality control for production. So
each reel is tuned, a level is chosen that all can reach, and every reel is made gentler along one
path until its cost is that level.
"""
