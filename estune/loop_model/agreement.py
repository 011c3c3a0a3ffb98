"""Whether the trials of each gains agree with one model of the loop.

Dry friction of constant size is the only force beside a linear loop that a model has. Friction
of another law, or a spring that stiffens, makes the loop depend on how it moves, which is not the
same with all gains: no one model explains all trials, and that of least squares lies somewhere
between. So the trials of each gains are fitted by themselves, with the friction of the model of
all. Where that explains them significantly better, by

    F = (S - S_own)/p / (S_own/(n - p)),

with S the sums of squared prediction errors of n samples and p the number of parameters, the loop
may be the one that they alone show.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.friction_motion import friction_force, less_friction
from estune.loop_model.identification import PoleFit, improve
from estune.loop_model.least_squares import FitSignals, Solution, signals_of
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import robustness
from estune.loop_model.model import LoopModel
from estune.loop_model.records import LoopRecord

CHANCE = 1e-3
"""Probability that trials which agree are taken not to, for each gains."""


def contradicting_sensitivities(
    fit: LoopFit,
    records: Sequence[LoopRecord],
    gains: Gains,
    controller: ControllerSettings,
) -> tuple[float, ...]:
    """Ms by the trials of each gains that do not agree with the fit; empty where all do.

    Infinite where a loop that they show is unstable. A fit whose errors are white leaves nothing
    to disagree about.
    """
    if fit.is_white:
        return ()
    models = (_own_model(fit, records, numbers) for numbers in _by_gains(fit, records))
    return tuple(
        robustness(model, gains, controller).sensitivity for model in models if model is not None
    )


def _by_gains(fit: LoopFit, records: Sequence[LoopRecord]) -> Iterator[list[int]]:
    """Numbers of the fitted trials from rest of each gains and setpoint.

    The setpoint filter is not the loop's. None where there is but one.
    """
    found = dict[tuple[tuple[float, ...], bytes], list[int]]()
    for i, record in enumerate(records):
        if record.at_rest and record.gains is not None and i not in fit.left_out:
            key = record.gains.as_tuple()[:3], record.setpoint.tobytes()
            found.setdefault(key, []).append(i)
    if len(found) > 1:
        yield from found.values()


def _own_model(
    fit: LoopFit, records: Sequence[LoopRecord], numbers: Sequence[int]
) -> LoopModel | None:
    """The linear model of some records; None where they agree with that of all."""
    from scipy.special import fdtrc  # noqa: PLC0415  slow to import

    own = [records[i] for i in numbers]
    signals = _without_friction(fit, own)
    start = PoleFit(0.0, np.array(fit.model.coordinates), fit.model.dead_samples, fit.noise)
    found = improve(signals, start)
    at = Solution.at(signals, found.coordinates, found.dead, found.noise)
    free = found.coordinates.size + at.numerator.size
    rest = at.residual.size - free
    squares = sum(float(fit.errors[i] @ fit.errors[i]) for i in numbers)
    F = (squares - at.squares) / free / (at.squares / rest)
    if fdtrc(free, rest, max(F, 0.0)) > CHANCE:
        return None
    return LoopModel(tuple(found.coordinates.tolist()), tuple(at.numerator.tolist()), found.dead)


def _without_friction(fit: LoopFit, records: Sequence[LoopRecord]) -> FitSignals:
    """The signals of records with the friction of a model taken off their effort."""
    model, settling = fit.model, fit.settling_samples
    signals = signals_of(records, settling, round(settling))
    if not model.friction:
        return signals
    taps, most = model.sections[0].taps[np.newaxis], np.array([model.friction])
    forces = []
    for group in signals.groups:
        efforts = np.array([records[i].effort for i in group.members])
        rest = np.array([[records[i].rest_effort for i in group.members]])
        forces.append(friction_force(efforts, taps, most, rest)[0])
    return less_friction(signals, forces)
