"""The part of long records that a loop is fitted to, and whether it speaks for the rest.

A fit takes time and memory with each sample, while its intervals soon show little but the error of
a model that always remains. Of a chamber whose setpoint steps every 160 samples the half width of
ln Ms, by what the setpoint excites, is 0.3 % after 2 000 samples and 0.03 % after 200 000, and 2 %
remain of either.
"""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.intervals import setpoint_deviation
from estune.loop_model.loop_fit import NORMAL_QUANTILE, LoopFit
from estune.loop_model.margins import robustness
from estune.loop_model.records import LoopRecord
from estune.service_records.plant_change import evidence

WINDOWS, SAMPLES, SETTLING_TIMES = 4, 1 << 16, 250.0
"""Windows that are fitted, and samples of each, or settling times where they are longer. Records
of 300 settling times gave gains within 5 % of the best cost in 44 of 44 loops."""

WIDEST = 0.01
"""Half width of ln Ms by the part, counting what the setpoint excites, and the difference of ln Ms
that the rest may make: each half of the error that always remains."""


def moved_most(
    records: Sequence[LoopRecord], settling_samples: float
) -> tuple[list[LoopRecord], list[LoopRecord]]:
    """The windows of records in which the setpoint moves most, the later of equals, and the rest.

    Records that are not longer than those windows are whole, and leave no rest.
    """
    window = max(SAMPLES, math.ceil(SETTLING_TIMES * settling_samples))
    if sum(record.samples for record in records) <= WINDOWS * window:
        return list(records), []
    pieces = [piece for record in records for piece in _cut(record, window)]
    ways = [float(np.abs(np.diff(piece.setpoint)).sum()) for piece in pieces]
    kept, samples = set[int](), 0
    for number in sorted(range(len(pieces)), key=lambda i: (-ways[i], -i)):
        if samples < WINDOWS * window:
            kept.add(number)
            samples += pieces[number].samples
    return (
        [piece for i, piece in enumerate(pieces) if i in kept],
        [piece for i, piece in enumerate(pieces) if i not in kept],
    )


def _cut(record: LoopRecord, window: int) -> list[LoopRecord]:
    """A record in equal pieces of at most a window."""
    ends = np.linspace(0, record.samples, math.ceil(record.samples / window) + 1).astype(int)
    signals = record.effort, record.measurement, record.setpoint
    return [
        record._replace(effort=effort, measurement=measurement, setpoint=setpoint)
        for effort, measurement, setpoint in zip(
            *(np.split(signal, ends[1:-1]) for signal in signals), strict=True
        )
    ]


def speaks_for(
    fit: LoopFit,
    fitted: Sequence[LoopRecord],
    rest: Sequence[LoopRecord],
    gains: Gains,
    settings: ControllerSettings,
) -> bool:
    """Whether a fit knows Ms as well as all records would, and the rest would not change it.

    The rest moves the parameters by its score over the information of all (`plant_change`).
    """
    Ms = robustness(fit.model, gains, settings).sensitivity
    if not math.isfinite(Ms):
        return False
    if not NORMAL_QUANTILE * setpoint_deviation(fit, fitted, gains, settings) <= WIDEST:
        return False
    of_rest = [evidence(fit, record) for record in rest]
    of_fitted = [evidence(fit, record) for record in fitted]
    information = np.sum([one.information for one in (*of_rest, *of_fitted)], axis=0)
    score = np.sum([one.score for one in of_rest], axis=0)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    step = np.linalg.lstsq(information / np.outer(scale, scale), -score / scale, rcond=1e-10)[0]
    parameters = fit.model.parameters
    parameters[: step.size] += step / scale
    moved = robustness(fit.model.with_parameters(parameters), gains, settings).sensitivity
    return abs(math.log(moved / Ms)) <= WIDEST
