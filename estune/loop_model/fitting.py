"""The loop model that records identify: linear, and with dry friction where they ask for it."""

from collections.abc import Sequence

from estune.loop_model.friction import fit_with_friction
from estune.loop_model.identification import LoopFit, LoopRecord, fit_linear_loop
from estune.loop_model.model import LoopModel

FRICTION_FROM = 0.002
"""Misfit of the linear model from which dry friction is tried. Timid trials of the reference reel
with 0.005 N m leave 0.4 %, and give its loop a sensitivity of 2.3 for 1.6."""

TRIED_WITH = (1, 2, 4, 8)
"""Numbers of records with which friction is tried again where it was not found with fewer: it
takes half a second."""

FRICTION_GAIN = 0.8
"""Residual over that of the linear model up to which friction is kept."""


def fit_loop(
    records: Sequence[LoopRecord],
    sampling_Hz: float,
    settling_time_s: float,
    last: LoopModel | None = None,
) -> LoopFit:
    """The loop model that fits records best.

    Args:
        records: At least one; all of one step trial.
        sampling_Hz: Sampling rate.
        settling_time_s: Settling time asked for, which sets the scale of the search.
        last: Model of an earlier fit to start from.
    """
    linear = fit_linear_loop(records, sampling_Hz, settling_time_s, last)
    earlier = last if last is not None and last.friction_N else None
    again = earlier is not None or last is None or len(records) in TRIED_WITH
    if not (linear.misfit > FRICTION_FROM and again):
        return linear
    found = fit_with_friction(records, linear, sampling_Hz, settling_time_s, earlier)
    if found is None or found.residual_N >= FRICTION_GAIN * linear.residual_N:
        return linear
    return found
