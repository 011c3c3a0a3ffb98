"""Static transparency: effect of eyelet friction on a tension, and its measurement.

The two-reel procedure estimates the attenuation ratio B and the friction coefficient C_R of two
equal reels of which one has a calibrated gauge:

bench = SimulatedBench(ReelModel(), ReelModel(gauge=Gauge(zero=3.0, sensitivity=0.8)))
procedure = TwoReelProcedure(setpoints_N=(8.0, 16.0, 24.0, 32.0, 40.0))
result = evaluate(procedure.run(bench), angles_x_rad=[2.1])
print(result.friction_coefficient, result.resolved, result.transparency().verdict)

`procedure.run` takes any `Bench`, also one of real reels. The equations are in the modules
`geometry` (11) to (13), `contact` (14) to (20), `friction_ratio` (21) to (26) and `index` (27) to
(29).
"""

from experiments.paper.two_reels.bench import SimulatedBench
from experiments.paper.two_reels.bench_parts import BenchDrive, BenchGauge, Eyelet, ReelModel
from experiments.paper.two_reels.evaluation import TwoReelResult, evaluate
from experiments.paper.two_reels.friction_ratio import attenuation
from experiments.paper.two_reels.geometry import eyelet_angle_rad
from experiments.paper.two_reels.hysteresis import HysteresisLoop, HysteresisTest
from experiments.paper.two_reels.index import WEBER_LIMIT
from experiments.paper.two_reels.procedure import SetpointReadings, TwoReelProcedure
from experiments.paper.two_reels.reel_comparison import ReelComparison, compare_reels
from experiments.paper.two_reels.rig import Bench, BenchReading, BenchRecord, BenchReel

__all__ = [
    "WEBER_LIMIT",
    "Bench",
    "BenchDrive",
    "BenchGauge",
    "BenchReading",
    "BenchRecord",
    "BenchReel",
    "Eyelet",
    "HysteresisLoop",
    "HysteresisTest",
    "ReelComparison",
    "ReelModel",
    "SetpointReadings",
    "SimulatedBench",
    "TwoReelProcedure",
    "TwoReelResult",
    "attenuation",
    "compare_reels",
    "evaluate",
    "eyelet_angle_rad",
]
