"""The model of one pair of poles more that a fit leaves out, though the records show it.

The Bayesian criterion asks 10 of ln L for each further parameter of a long record. A pair that
brings half of that is left out, rightly for the margins; but its model foretells another step: on
the reference reel with a mode at 25 Hz, in a busy record of 300 settling times, the pair brings 21
and an overshoot of 6.5 % where the fit states 5.0 (4.4 to 5.5) and 6.3 % is true.
"""

from collections.abc import Sequence

import numpy as np

from estune.loop_model.fit_signals import signals_of
from estune.loop_model.further_poles import POLES_MAX, with_further_pair
from estune.loop_model.loop_fit import LoopFit, model_of
from estune.loop_model.model import LoopModel
from estune.loop_model.records import LoopRecord

PARAMETERS = 4
"""Parameters of a pair: its poles and two terms of the numerator."""

CHANCE = 0.01
"""Probability of the gain in ln L by chance, at any of the frequencies that a record resolves: a
hardly damped pair explains one line of the noise."""


def rival_model(fit: LoopFit, records: Sequence[LoopRecord]) -> LoopModel | None:
    """The model with one more pair of poles, where it fits better beyond chance.

    Without friction, and not of single poles.
    """
    from scipy.special import chdtrc  # noqa: PLC0415  slow to import

    if fit.model.friction or fit.order % 2 or fit.order + 2 > POLES_MAX:
        return None
    signals = signals_of(fit.fitted(records), fit.settling_samples)
    more = with_further_pair(signals, fit.poles)
    before, after = (one.solution(signals) for one in (fit.poles, more))
    # Below the resolution of the measurement nothing is left to explain.
    least = signals.samples * signals.resolution**2
    gain = signals.samples * np.log((before.squares + least) / (after.squares + least))
    lines = 0.5 * signals.longest
    if not lines * chdtrc(PARAMETERS, max(float(gain), 0.0)) < CHANCE:
        return None
    return model_of(after)
