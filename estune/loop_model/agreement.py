"""Whether the trials of each gains agree with one model of the loop.

Dry friction of constant size is the only force beside a linear loop that a model has. Friction
of another law, or a spring that stiffens, makes the loop depend on how it moves, which is not the
same with all gains: no one model explains all trials, and that of least squares lies somewhere
between. So the trials of each gains near those in question are fitted by themselves. Where that
explains them significantly better, by

    F = (S - S_own)/p / (S_own/(n - p)),

with S the sums of squared prediction errors of n samples and p the number of parameters, the loop
may be the one that they alone show.
"""

from collections.abc import Iterator, Sequence

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.fitting import fit_loop
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import robustness
from estune.loop_model.model import LoopModel
from estune.loop_model.near_fit import is_explained, is_near
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
    if is_explained(fit):
        return ()
    models = (_own_model(fit, records, numbers) for numbers in _by_gains(fit, records, gains))
    return tuple(
        robustness(model, gains, controller).sensitivity for model in models if model is not None
    )


def _by_gains(fit: LoopFit, records: Sequence[LoopRecord], gains: Gains) -> Iterator[list[int]]:
    """Numbers of the fitted trials from rest of each gains near some and each setpoint.

    The setpoint filter is not the loop's. None where there is but one. What timid trials alone
    would foretell of these gains says nothing of them.
    """
    found = dict[tuple[tuple[float, ...], bytes], list[int]]()
    for i, record in enumerate(records):
        if record.at_rest and is_near(record, gains) and i not in fit.left_out:
            assert record.gains is not None  # noqa: S101  it is near some
            key = record.gains.as_tuple()[:3], record.setpoint.tobytes()
            found.setdefault(key, []).append(i)
    if len(found) > 1:
        yield from found.values()


def _own_model(
    fit: LoopFit, records: Sequence[LoopRecord], numbers: Sequence[int]
) -> LoopModel | None:
    """The model of some records; None where they agree with that of all."""
    from scipy.special import fdtrc  # noqa: PLC0415  slow to import

    own = fit_loop([records[i] for i in numbers], 1.0, fit.settling_samples)
    free = own.model.parameters.size
    rest = sum(errors.size for errors in own.errors) - free
    of_all, alone = (
        sum(float(errors @ errors) for errors in each)
        for each in ([fit.errors[i] for i in numbers], own.errors)
    )
    F = (of_all - alone) / free / (alone / rest)
    return None if fdtrc(free, rest, max(F, 0.0)) > CHANCE else own.model
