"""Reels that hold one body by their cables: a platform, or the carriage of a two-reel bench.

`Mechanism` has the equations, `Simulation` the reels with their hybrid controllers, and
`RealTimePlatform` lets each reel be served as a rig that follows setpoints. `distribute` and
`PoseController` are the layers above: they turn a pose into a wrench, and that into tensions.
"""

from plants.bench.cable_platform.distribution import distribute
from plants.bench.cable_platform.mechanism import Mechanism, bench_carriage, planar_platform
from plants.bench.cable_platform.pose_control import PoseController
from plants.bench.cable_platform.real_time import PlatformReel, RealTimePlatform
from plants.bench.cable_platform.simulation import Simulation

__all__ = [
    "Mechanism",
    "PlatformReel",
    "PoseController",
    "RealTimePlatform",
    "Simulation",
    "bench_carriage",
    "distribute",
    "planar_platform",
]
