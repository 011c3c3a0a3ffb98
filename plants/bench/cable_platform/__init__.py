"""Reels that hold one body by their cables: a platform, or the carriage of a two-reel bench.

`Mechanism` has the equations, `Simulation` the reels with their hybrid controllers, and
`RealTimePlatform` lets each reel be served as a rig that follows setpoints.
"""

from plants.bench.cable_platform.mechanism import Mechanism, bench_carriage, planar_platform
from plants.bench.cable_platform.real_time import PlatformReel, RealTimePlatform
from plants.bench.cable_platform.simulation import Simulation

__all__ = [
    "Mechanism",
    "PlatformReel",
    "RealTimePlatform",
    "Simulation",
    "bench_carriage",
    "planar_platform",
]
