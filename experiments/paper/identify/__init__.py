"""Identification of a reel: excitation, frequency response, second-order model.

excitation = multisine(632.0, Band(0.5, 310.0), peak_N=40.0, slope=1.5, corner_Hz=20.0)
record = open_loop_record(reference_reel(0.8, 15.0), excitation)
fit = fit_second_order(response_of_record(record, excitation))
print(fit.resonance_Hz, fit.damping, fit.dead_time_s)
"""

from experiments.paper.identify.dependence import Condition, Dependence
from experiments.paper.identify.distortion import HarmonicDistortion
from experiments.paper.identify.estimate import Estimate
from experiments.paper.identify.excitation import (
    Band,
    BroadbandExcitation,
    Segment,
    chirp,
    multisine,
    stepped_sine,
)
from experiments.paper.identify.frequency_response import (
    FrequencyResponse,
    frequency_response,
    response_of_record,
)
from experiments.paper.identify.open_loop import open_loop_record
from experiments.paper.identify.second_order import SecondOrderFit, fit_second_order

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
