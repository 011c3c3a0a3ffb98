"""Identification of a reel: excitation, frequency response, second-order model.

excitation = multisine(632.0, Band(0.5, 310.0), peak_N=40.0, slope=1.5, corner_Hz=20.0)
record = open_loop_record(reference_reel(0.8, 15.0), excitation)
fit = fit_second_order(response_of_record(record, excitation))
print(fit.resonance_Hz, fit.damping, fit.dead_time_s)
"""

from plants.bench.identify.dependence import Condition, Dependence
from plants.bench.identify.distortion import HarmonicDistortion
from plants.bench.identify.estimate import Estimate
from plants.bench.identify.excitation import (
    Band,
    BroadbandExcitation,
    Segment,
    chirp,
    multisine,
    stepped_sine,
)
from plants.bench.identify.frequency_response import (
    FrequencyResponse,
    frequency_response,
    response_of_record,
)
from plants.bench.identify.open_loop import open_loop_record
from plants.bench.identify.second_order import SecondOrderFit, fit_second_order

__all__ = [
    "Band",
    "BroadbandExcitation",
    "Condition",
    "Dependence",
    "Estimate",
    "FrequencyResponse",
    "HarmonicDistortion",
    "SecondOrderFit",
    "Segment",
    "chirp",
    "fit_second_order",
    "frequency_response",
    "multisine",
    "open_loop_record",
    "response_of_record",
    "stepped_sine",
]
