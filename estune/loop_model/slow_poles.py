"""Poles slower than all records, which are integrators to them."""

import math

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.criterion import judged
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.identification import PoleFit, searched_dead_time
from estune.loop_model.poles import sections_of, slowest_decay, with_single
from estune.loop_model.whiteness import is_white

INTEGRATOR = 1e-2
"""Decay over the longest record from which on a pole is no integrator to it. The search moves one
that it does not need towards none, and the numerator with it to the wrong sign: on a lag of the
third order with a zero in the right half plane it ended at e^-41 per sample, and no gains made a
stable loop. A double integrator in noise is found with 0.3."""


def without_slowest_pole(signals: FitSignals, fit: PoleFit) -> PoleFit:
    """The fit of more than two poles without one slower than all records, if the criterion falls.

    To the records it is an integrator, and a small one of the wrong sign, which they do not tell
    from none, leaves no stable loop.
    """
    poles = np.concatenate([section.log_poles for section in sections_of(fit.coordinates)])
    # Two integrators may be a pair that turns by less than the records tell.
    still = np.abs(poles.imag) * _longest(signals) < INTEGRATOR
    real = sorted(np.abs(poles[still]).tolist())
    if fit.coordinates.size < 3 or len(real) < 2 or is_resolved(signals, fit.coordinates):
        return fit
    if poles.real.max() > 0.0:  # one outside the unit circle is none of the plant's integrators
        return fit
    turning = poles[~still & (poles.imag > 0.0)]
    sizes = np.abs(turning)
    fewer = np.log(np.column_stack([sizes, -turning.real / sizes])).ravel()
    for rate in real[1:]:
        fewer = with_single(fewer, math.log(rate))
    tried = judged(signals, searched_dead_time(signals, [fit._replace(coordinates=fewer)]))
    return tried.fit if tried.criterion < judged(signals, fit).criterion else fit


def is_resolved(signals: FitSignals, coordinates: FloatArray, least: float = 1.0) -> bool:
    """Whether no pole is slower than all records: it decays by more than this over the longest."""
    return bool(slowest_decay(coordinates) * _longest(signals) > least)


def _longest(signals: FitSignals) -> int:
    """Samples of the longest record."""
    return max(int(group.effort.shape[1]) for group in signals.groups)


def is_controllable(signals: FitSignals, fit: PoleFit) -> bool:
    """Whether the plant of trials from rest is no integrator of the wrong sign."""
    if signals.in_motion or is_resolved(signals, fit.coordinates, INTEGRATOR):
        return True
    return bool(fit.solution(signals).numerator[0] > 0.0)


def is_settled(signals: FitSignals, fit: PoleFit) -> bool:
    """Whether no pole is slower than all records, or its sign is that of a stable loop.

    In trials from rest such a fit has to explain them besides. A double integrator with a lag
    looks like two poles that are resolved until it has the third.

    In records of service a load takes the place of a slow pole that is refused: with it the step
    response of the chamber of `tests/test_loop_records.py` is 3 % of the true one after 300 of
    its 700 samples.
    """
    if is_resolved(signals, fit.coordinates):
        return True
    solution = fit.solution(signals)
    if signals.in_motion:
        return bool(solution.numerator[0] > 0.0)
    return is_white(signals, solution.residual) and is_controllable(signals, fit)
