"""How a loop behaves beside its step: tracking and rest, measured by two trials more.

A step hides much of what a machine does to a loop; see `estune.trial.tracking`. The same numbers
prove a remedy (`estune.proof`) and stand beside the cost in results and comparisons.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.errors import Interrupted, InvalidInput, RigError
from estune.run.failed_trials import cut_off, needs_operator, run_trial
from estune.run.journal import Journal
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest
from estune.trial.profiles import Profile, StepProfile, TriangleProfile
from estune.trial.tracking import (
    TriangleTracking,
    rest_of,
    resting_profile,
    tracking_of,
    tracking_profile,
)


class LoopBehaviour(NamedTuple):
    """Tracking and rest of a loop at some gains; see `estune.trial.tracking`.

    Attributes:
        tracking: Root mean square of the error on a slow triangle.
        reversal: Mean of the greatest errors shortly after its reversals.
        rest: Standard deviation of the tension at rest.
    """

    tracking: float
    reversal: float
    rest: float


def behaviour_profiles(about: RigDescription) -> tuple[StepProfile, TriangleProfile]:
    """The step with the rest after it, and the slow triangle.

    Raises:
        InvalidInput: the rig's limits do not allow one of them.
    """
    resting = resting_profile(about.step, about.settling_time_s)
    triangle = tracking_profile(about.step, about.settling_time_s)
    about.limits.check_each(resting, triangle)
    return resting, triangle


def measure_behaviour(
    rig: Rig, about: RigDescription, gains: Gains, run: str, journal: Journal | None = None
) -> LoopBehaviour:
    """Runs a step with the rest after it, and a slow triangle.

    Args:
        gains: Gains of both trials.
        run: Name under which the rig knows the two trials; they run once.
        journal: Where they are noted; None without one.

    Raises:
        InvalidInput: the rig's limits do not allow a trial.
        Interrupted: a trial was interrupted on a rig that moves: an operator has to check it.
        RigError: the rig cannot be reached, or a trial ended early.
    """
    resting, triangle = behaviour_profiles(about)
    profiles: tuple[Profile, ...] = resting, triangle
    records = []
    for number, profile in enumerate(profiles):
        record = run_trial(rig, TrialRequest(run, number, gains, profile), about, notes=journal)
        if record.outcome is not Outcome.DONE:
            if needs_operator(record, about):
                raise Interrupted(cut_off(record))
            why = record.reason or record.outcome.sentence
            raise RigError(f"trial {record.trial_id} ended early: {why}")
        records.append(record)
    rested, followed = records
    return LoopBehaviour(*tracking_in(followed, about, triangle), rest_in(rested, about))


Measured = Mapping[str, LoopBehaviour | str]
"""Behaviour by the name of its gains, `start` or `tuned`; or why it was not measured."""


def measure_all(
    rig: Rig, about: RigDescription, run: str, gains: Mapping[str, Gains], journal: Journal | None
) -> Measured:
    """Behaviour at several gains, after the run of a name; a failure is kept as its sentence."""
    found: dict[str, LoopBehaviour | str] = {}
    for name, one in gains.items():
        try:
            named = f"{run}-{name}-behaviour"
            found[name] = measure_behaviour(rig, about, one, named, journal)
        except Interrupted as error:  # nothing moves a rig of which nobody knows how it stands
            return found | {name: str(error)}
        except (InvalidInput, RigError) as error:
            found[name] = str(error)
    return found


def stored_behaviour(journal: Journal) -> Measured:
    """What a journal has of it; empty where the run was not asked for it."""
    stored = journal.fact("behaviour") or {}
    return {
        name: found if isinstance(found, str) else LoopBehaviour(*found)
        for name, found in stored.items()
    }


def rest_in(record: TrialRecord, about: RigDescription) -> float:
    """Standard deviation of the tension at rest, of a record of a `resting_profile`."""
    rate = about.controller.sampling_Hz
    return rest_of(about.settling_time_s, rate, record.unfiltered)


def step_cost_in(record: TrialRecord, about: RigDescription) -> float:
    """Cost of the step in such a record; of the whole current, with what is fed forward."""
    rate = about.controller.sampling_Hz
    used = slice(about.step.samples(rate))
    effort = record.current_A[used] * about.newtons_per_ampere
    cost = default_cost(about.settling_time_s).scaled(about.effort_scale or 1.0)
    columns = record.setpoint_N[used], record.unfiltered[used], effort
    return float(cost.evaluate(rate, about.step.shape(rate), *columns))


def tracking_in(
    record: TrialRecord, about: RigDescription, triangle: TriangleProfile
) -> TriangleTracking:
    """Tracking in a record of a slow triangle."""
    error = record.setpoint_N - record.unfiltered
    return tracking_of(triangle, about.settling_time_s, about.controller.sampling_Hz, error)


def behaviour_rows(
    measured: Measured, text: Callable[[float, int], str], empty: str
) -> list[tuple[str, str, str]]:
    """The numbers as text: label, at the start gains, at the tuned gains.

    Args:
        measured: What was measured.
        text: A measurement and its digits as text with the unit, `RigDescription.measured`.
        empty: Text of a number that there is not.
    """
    found = [measured.get(name) for name in ("start", "tuned")]
    if not any(isinstance(one, LoopBehaviour) for one in found):
        return []
    cells = [
        [text(value, 3) for value in one] if isinstance(one, LoopBehaviour) else [empty] * 3
        for one in found
    ]
    labels = "tracking error (rms)", "error at reversals", "deviation at rest"
    return list(zip(labels, *cells, strict=True))


def behaviour_remarks(measured: Measured) -> list[str]:
    """Why numbers are missing, a sentence each."""
    return [
        f"tracking and rest of the {name} gains are not measured: {found}"
        for name, found in measured.items()
        if isinstance(found, str)
    ]
