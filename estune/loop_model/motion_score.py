"""Whether the errors of a fit, or its plant, change with the motion that the setpoint asks for.

Load and noise of a linear loop know nothing of its setpoint, and its plant is the same in fast
motion as in slow. Friction acts only where there is motion, and a model of load takes it in: at an
eyelet that lets 0.93 of the tension through, Ms of busy records is read as 1.3 to 1.5, with narrow
intervals, where it is 1.87 at a stop. Of what a linear predictor (`linear_past`) and a linear
answer to the setpoint leave of the errors two scores that know nothing of each other are added:

- the power of the errors, in windows of a sixteenth of the settling time, against the speed of the
  model's answer to the setpoint, by ranks of the speed;
- what the errors gain from poles and numerator of their own in the fastest tenth of the time, by
  their slopes there.
"""

import math
from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.fit_signals import FitSignals, signals_of
from estune.loop_model.limited_loop import setpoint_response
from estune.loop_model.linear_past import less, linear_answers, linear_past, orthonormal
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.records import LoopRecord, rounding_std

WINDOWS = 16
"""Windows in a settling time. The score is 4.7 to 5.9 in four busy records of the eyelet, 4.1 to
5.2 in three of small steps with friction and at most 1.2 in ten of linear loops; with 8 windows
3.7 to 4.9, 3.8 to 5.7 and 1.3, with 32 3.7 to 6.2, 3.4 to 4.3 and 1.5."""

SMOOTHED = 4
"""Windows that a speed is averaged over: friction shows for a while after a motion."""

FAST = 0.1
"""Share of the time, the fastest, in which the plant may be another. Of 16 busy records of the
eyelet the tests find 12. With a quarter of the time and half of it the steps of an encoder pass
for another plant: a linear loop has a chi-squared of 60 and 72, where it has 9."""

MOTIONS = 3
"""Fewest separate fast motions that show a dependence on motion: what disturbs one of two decides.
Logs of a heated chamber with one or two steps are refused by either score, up to 7 standard
deviations of power, where the model of all logs predicts them; busy records of 80 settling times
have 3 to 9."""

LAGS = 2
"""Samples before that the linear predictor knows. With four the probability of a busy record of
the eyelet is 0.021 and with eight 0.33, for it takes in the plant; with two it is 0.001, and 0.014
in 5 000 samples of a linear loop with coloured noise, 0.5 to 0.6 in two logs of other noise."""

APART = 1e-4
"""Least share of the largest singular value by which slopes differ."""

CHANCE = 0.01
"""Probability that a linear loop is taken to change with its motion. Of 24 linear logs the least
is 0.05. Four records of the eyelet of 16 are not found, at 0.02 to 0.4, and one of them states Ms
as 1.50 (1.42 to 1.60) for 1.87: what it showed without `linear_answers` is what a linear model
lacks, and linear loops show as much."""


def changes_with_motion(
    fit: LoopFit, records: Sequence[LoopRecord], controller: ControllerSettings
) -> bool:
    """Whether errors or plant of a fit change with motion beyond chance, in records of service.

    Trials from rest do not count: after a step all signals decay together. Nor does a fit with
    friction, which holds what changes: its small errors show in long records, and matter little.
    """
    from scipy.special import chdtrc  # noqa: PLC0415  slow to import

    moved = [
        (record, motion)
        for record in fit.fitted(records)
        if (motion := _motion(fit, record, controller)) is not None
    ]
    if fit.model.friction or _motions(fit, [motion.speed for _, motion in moved]) < MOTIONS:
        return False
    kept = [record for record, _ in moved]
    signals = signals_of(kept, fit.settling_samples)
    resolution = max(signals.resolution, *(rounding_std(record.measurement) for record in kept))
    model = fit.model
    at = fit.solution(signals)
    slopes = at.slopes(signals)
    motions = [[moved[i][1] for i in group.members] for group in signals.groups]
    answers = linear_answers(signals, [(m.output, m.effort) for _, m in moved])
    laws = chain(slopes.T, linear_past(signals, LAGS), answers)
    known = orthonormal(signals.samples, laws)
    errors = less(at.residual, known)
    speeds = [
        motion.speed[group.history :]
        for group, of in zip(signals.groups, motions, strict=True)
        for motion in of
    ]
    power = max(_power_score(fit, signals, errors, speeds, resolution), 0.0)
    own = slopes[:, : model.order + len(model.numerator)]
    squares, freedom = _plant_score(own, known, errors, np.concatenate(speeds), resolution)
    return bool(chdtrc(freedom + 1, squares + power**2) < CHANCE)


def _motions(fit: LoopFit, speeds: Sequence[FloatArray]) -> int:
    """Fast motions that are more than a settling time apart."""
    least = np.quantile(np.concatenate([*speeds, [0.0]]), 1.0 - FAST)
    fast = [np.flatnonzero(speed > least) for speed in speeds]
    return sum(1 + int((np.diff(at) > fit.settling_samples).sum()) for at in fast if at.size)


def _window(fit: LoopFit) -> int:
    return max(round(fit.settling_samples / WINDOWS), 1)


class _Motion(NamedTuple):
    """What the model answers to the setpoint of a record, shape (samples,) each.

    Attributes:
        speed: Mean speed in the windows before each sample; none where it is at a limit: a warm-up
            is like a trial from rest, and goes through levels at which the plant is another one.
    """

    output: FloatArray
    effort: FloatArray
    speed: FloatArray


def _motion(fit: LoopFit, record: LoopRecord, controller: ControllerSettings) -> _Motion | None:
    """The motion of a record in service; None of another."""
    if record.at_rest or record.gains is None or not np.ptp(record.setpoint):
        return None
    output, effort = setpoint_response(fit.model, record, record.gains, controller)
    if not np.isfinite(output).all():
        return None
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(output, prepend=output[0])))])
    ends = np.arange(1, way.size)
    before = SMOOTHED * _window(fit)
    speed = way[ends] - way[np.maximum(ends - before, 0)]
    held = np.isin(effort, np.asarray(record.limits) - record.effort[0])
    near = np.convolve(held, np.ones(before + 1))[: held.size] > 0.0
    return _Motion(output, effort, np.where(near, 0.0, speed))


def _power_score(
    fit: LoopFit,
    signals: FitSignals,
    errors: FloatArray,
    speeds: Sequence[FloatArray],
    resolution: float,
) -> float:
    """Correlation of errors' power and motion, in standard deviations without any.

    The steps of a converter show in motion alone: below them errors are as large as they are.
    """
    window = _window(fit)
    products = powers = 0.0
    rows = [row for group in signals.split(errors) for row in group]
    for row, speed in zip(rows, speeds, strict=True):
        count = row.size // window
        if count < 2 * SMOOTHED:
            continue
        used = slice(0, count * window)
        power = row[used].reshape(count, -1).mean(axis=1) ** 2
        power = np.maximum(power, resolution**2)
        power = power / max(float(power.mean()), 1e-300) - 1.0
        rank = np.argsort(np.argsort(speed[used][window - 1 :: window])) - 0.5 * (count - 1)
        products += float(power @ rank)
        powers += float(power @ power) / count * float(rank @ rank)
    return products / math.sqrt(powers) if powers else 0.0


def _plant_score(
    slopes: FloatArray,
    known: FloatArray,
    errors: FloatArray,
    speed: FloatArray,
    resolution: float,
) -> tuple[float, int]:
    """Chi-squared of a plant of its own in the fastest motion, and its degrees of freedom."""
    fast = speed > np.quantile(speed, 1.0 - FAST)
    own = slopes * fast[:, np.newaxis]
    own = less(own / np.maximum(np.linalg.norm(own, axis=0), 1e-300), known)
    own = own / np.maximum(np.linalg.norm(own, axis=0), 1e-300)
    basis, sizes, _ = np.linalg.svd(own, full_matrices=False)
    basis = basis[:, sizes > APART * sizes[0]]
    gained = basis.T @ errors
    squares = float(gained @ gained)
    # Errors that are no more than rounding follow a fast motion as well: in a linear loop with an
    # encoder the other plant explained 0.75 of a rounding error.
    if squares < resolution**2 * int(fast.sum()):
        return 0.0, basis.shape[1]
    variance = float(errors @ errors) / errors.size + resolution**2
    return squares / variance, basis.shape[1]
