"""Static transparency: effect of eyelet friction on a tension, and its measurement.

The two-reel procedure estimates the attenuation ratio B and the friction coefficient C_R of two
equal reels of which one has a calibrated gauge:

bench = SimulatedBench(ReelModel(), ReelModel(gauge=Gauge(zero=3.0, sensitivity=0.8)))
procedure = TwoReelProcedure(setpoints_N=(8.0, 16.0, 24.0, 32.0, 40.0))
result = evaluate(procedure.run(bench), angles_x_rad=[2.1])
print(result.friction_coefficient, result.resolved, result.transparency().verdict)

`procedure.run` takes any `Bench`, also one of real reels.
"""

from plants.two_reel_bench.bench import SimulatedBench
from plants.two_reel_bench.bench_parts import Drive, Eyelet, Gauge, ReelModel
from plants.two_reel_bench.contact import (
    ContactForce,
    contact_force_N,
    friction_N,
    plane_tensions_N,
    split_contact_force,
    sticks,
    tension_outside_N,
)
from plants.two_reel_bench.evaluation import TwoReelResult, evaluate
from plants.two_reel_bench.friction_curve import FrictionCurve
from plants.two_reel_bench.friction_ratio import (
    attenuated_tension_N,
    attenuation,
    capital_gamma,
    equivalent_attenuation,
    friction_coefficient,
    sliding_excess_N,
)
from plants.two_reel_bench.geometry import (
    angle_between_rad,
    contact_line,
    direction_inside,
    direction_outside,
    eyelet_angle_rad,
)
from plants.two_reel_bench.hysteresis import HysteresisLoop, HysteresisTest
from plants.two_reel_bench.index import (
    WEBER_LIMIT,
    StaticTransparency,
    friction_share,
    log_mean,
    log_spread,
    static_transparency,
)
from plants.two_reel_bench.procedure import SetpointReadings, TwoReelProcedure
from plants.two_reel_bench.reel_comparison import ReelComparison, compare_reels
from plants.two_reel_bench.rig import Bench, BenchReading, BenchRecord, BenchReel

__all__ = [
    "WEBER_LIMIT",
    "Bench",
    "BenchReading",
    "BenchRecord",
    "BenchReel",
    "ContactForce",
    "Drive",
    "Eyelet",
    "FrictionCurve",
    "Gauge",
    "HysteresisLoop",
    "HysteresisTest",
    "ReelComparison",
    "ReelModel",
    "SetpointReadings",
    "SimulatedBench",
    "StaticTransparency",
    "TwoReelProcedure",
    "TwoReelResult",
    "angle_between_rad",
    "attenuated_tension_N",
    "attenuation",
    "capital_gamma",
    "compare_reels",
    "contact_force_N",
    "contact_line",
    "direction_inside",
    "direction_outside",
    "equivalent_attenuation",
    "evaluate",
    "eyelet_angle_rad",
    "friction_N",
    "friction_coefficient",
    "friction_share",
    "log_mean",
    "log_spread",
    "plane_tensions_N",
    "sliding_excess_N",
    "split_contact_force",
    "static_transparency",
    "sticks",
    "tension_outside_N",
]
