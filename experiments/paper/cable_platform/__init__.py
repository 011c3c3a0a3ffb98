"""Layers above the reels of a platform: from a pose to a wrench, and from that to tensions."""

from experiments.paper.cable_platform.distribution import distribute
from experiments.paper.cable_platform.pose_control import PoseController

__all__ = ["PoseController", "distribute"]
