"""One tuning run as a pure fold: what has been told decides what is asked next.

A run has three phases. `baseline` repeats the gains the rig came with, `search` lets the tuner
propose, `confirm` repeats what the tuner recommends, interleaved with the best trial it saw.
Nothing here reads a clock or a file, so replaying a journal's trials gives back the session, and
with it every later proposal, bit for bit.
"""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from statistics import fmean, variance
from typing import Any

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.tuners import Tuner
from estune.core.tuners.observation import Observation
from estune.errors import InvalidInput
from estune.profiles import StepProfile
from estune.trial import Outcome, TrialRequest


class Phase(StrEnum):
    """Where a trial belongs in a run."""

    BASELINE = "baseline"
    SEARCH = "search"
    CONFIRM = "confirm"


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that decides which trials a run asks for.

    Attributes:
        run: Name of the run; its trials' ids begin with it.
        tuner: The tuner and its settings; its search space is centred on `start`.
        start: The gains the run begins from: the rig's live ones, unless others were given.
        step: The step trial.
        cost: How a trial is scored.
        trials: Greatest number of search trials.
        repeats: Trials of the start gains before the search, and of each candidate after it.
        eta_max: A trial that costs more is unsafe (the paper's guard under (35)); None is
            `UNSAFE_RATIO` times the start's own cost.
        repeat_start: Whether the start is repeated once more among the candidates, in turn with
            them, so that a drift during the search is not taken for an improvement.

    Raises:
        InvalidInput: a count is too small, the limit is not above zero, or the settling time is
            longer than the trial.
    """

    run: str
    tuner: Tuner[Any]
    start: Gains
    step: StepProfile
    cost: StepCost
    trials: int = 120
    repeats: int = 3
    eta_max: float | None = None
    repeat_start: bool = False

    def __post_init__(self) -> None:
        if self.trials < 1 or self.repeats < 1:
            raise InvalidInput(
                f"{self.trials} search trials with {self.repeats} repeats: each must be at least 1"
            )
        if self.eta_max is not None and not (math.isfinite(self.eta_max) and self.eta_max > 0.0):
            raise InvalidInput(f"eta_max is {self.eta_max}; it must be finite and above zero")
        if self.step.loop != "closed":
            raise InvalidInput("an open-loop step cannot tune a controller; make it a closed one")
        after_s = self.step.duration_s - self.step.step_at_s
        if self.cost.settling_time_s > after_s:
            raise InvalidInput(
                f"settling time {self.cost.settling_time_s:g} s is longer than the {after_s:g} s "
                "after the step; make the trial longer, or choose a shorter settling time"
            )

    @property
    def most_trials(self) -> int:
        """The number of trials the run takes if nothing ends it early."""
        return self.trials + (4 if self.repeat_start else 3) * self.repeats


UNSAFE_RATIO = 3.0
"""A trial that costs this many times the start is unsafe, unless the user says otherwise."""

UNSAFE_IN_A_ROW = 12
"""So many unsafe trials in a row end the search: the tuner is not finding its way back."""


@dataclass(frozen=True, slots=True)
class Session:
    """Where a run stands: a value that `told` turns into the next one.

    Attributes:
        plan: What decides the run.
        tuner_state: The tuner's own state.
        number: Number of the trial to be asked next.
        attempt: How often that trial was void.
        searched: Search trials told.
        unsafe_in_a_row: Censored search trials since the last safe one.
        baseline: Costs of the start gains.
        candidates: Gains to be confirmed, once the search is over; the start first, if it is
            repeated.
        confirmed: Costs of each candidate, in their order; infinite where a trial was unsafe.
        search_end: Why the search ended; empty while it goes on.
        failure: Why the run can't go on at all; empty while it can.
    """

    plan: Plan
    tuner_state: Any
    number: int = 0
    attempt: int = 0
    searched: int = 0
    unsafe_in_a_row: int = 0
    baseline: tuple[float, ...] = ()
    candidates: tuple[Gains, ...] = ()
    confirmed: tuple[tuple[float, ...], ...] = ()
    search_end: str = ""
    failure: str = ""

    @property
    def phase(self) -> Phase | None:
        """The phase of the trial to be asked next; None when there is none."""
        if self.failure:
            return None
        if len(self.baseline) < self.plan.repeats:
            return Phase.BASELINE
        if not self.search_end:
            return Phase.SEARCH
        return Phase.CONFIRM if _unconfirmed(self) is not None else None

    @property
    def eta_max(self) -> float:
        """The cost above which a trial is unsafe; infinite until there is a baseline."""
        if self.plan.eta_max is not None:
            return self.plan.eta_max
        return UNSAFE_RATIO * fmean(self.baseline) if self.baseline else math.inf


def begin(plan: Plan) -> Session:
    """The session before its first trial."""
    return Session(plan, plan.tuner.start())


def next_request(session: Session) -> TrialRequest | None:
    """The trial to be run next, or None when the run is complete or has failed."""
    plan, phase = session.plan, session.phase
    if phase is None:
        return None
    if phase is Phase.BASELINE:
        gains = plan.start
    elif phase is Phase.SEARCH:
        gains = plan.tuner.space.gains(plan.tuner.ask(session.tuner_state))
    else:
        gains = session.candidates[_unconfirmed(session) or 0]
    return TrialRequest(plan.run, session.number, gains, plan.step, session.attempt)


def is_censored(session: Session, outcome: Outcome, cost: float) -> bool:
    """Whether the trial told nothing but that its gains are unsafe: the guard `eta < eta_max`."""
    return outcome is not Outcome.DONE or not math.isfinite(cost) or cost > session.eta_max


def told(session: Session, outcome: Outcome, cost: float) -> Session:
    """The session after the trial it asked for.

    Args:
        session: Where the run stood.
        outcome: How the trial ended.
        cost: Its cost eta; ignored unless the trial is done.
    """
    if outcome.is_void:
        return replace(session, attempt=session.attempt + 1)
    phase, censored = session.phase, is_censored(session, outcome, cost)
    changed: dict[str, Any]
    if phase is Phase.BASELINE and censored:
        changed = {"failure": _unsafe_start(session, outcome, cost)}
    elif phase is Phase.BASELINE:
        changed = {"baseline": (*session.baseline, cost)}
    elif phase is Phase.SEARCH:
        changed = _after_search(session, Observation(math.nan if censored else cost, censored))
    else:
        changed = {"confirmed": _confirmed_with(session, math.inf if censored else cost)}
    return replace(session, number=session.number + 1, attempt=0, **changed)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a run came to.

    Attributes:
        gains: The gains to use: the best confirmed ones, or the start where nothing beat it.
        cost: Their mean cost over the repeats.
        cost_error: Standard error of that mean; zero without repeats.
        start_cost: Mean cost of the start gains.
        start_cost_error: Standard error of that mean.
        improved: Whether the gains beat the start by more than two standard errors.
        message: The verdict in a sentence.
        complete: Whether the run came to its end; otherwise `gains` are the start.
    """

    gains: Gains
    cost: float
    cost_error: float
    start_cost: float
    start_cost_error: float
    improved: bool
    message: str
    complete: bool


def verdict(session: Session) -> Verdict:
    """What the run came to, so far as it went."""
    plan = session.plan
    repeated = plan.repeat_start and session.confirmed
    start_cost, start_error = _mean(session.confirmed[0] if repeated else session.baseline)
    as_it_was = Verdict(
        gains=plan.start,
        cost=start_cost,
        cost_error=start_error,
        start_cost=start_cost,
        start_cost_error=start_error,
        improved=False,
        complete=False,
        message=session.failure
        or f"stopped after {session.number} trials, before any gains were confirmed",
    )
    if session.failure or session.phase is not None:
        return as_it_was
    means = [_mean(costs) for costs in session.confirmed]
    (cost, error), gains = min(
        zip(means, session.candidates, strict=True), key=lambda pair: pair[0]
    )
    if start_cost - cost > 2.0 * math.hypot(start_error, error):
        message = f"the cost fell from {start_cost:.3g} to {cost:.3g}; {session.search_end}"
        return replace(
            as_it_was,
            gains=gains,
            cost=cost,
            cost_error=error,
            improved=True,
            complete=True,
            message=message,
        )
    message = (
        f"no gains beat the start beyond the scatter of {plan.repeats} repeats; "
        f"keep the start; {session.search_end}"
    )
    return replace(as_it_was, complete=True, message=message)


def _after_search(session: Session, observation: Observation) -> dict[str, Any]:
    """What a search trial changes."""
    tuner = session.plan.tuner
    state = tuner.tell(session.tuner_state, observation)
    searched = session.searched + 1
    unsafe = session.unsafe_in_a_row + 1 if observation.censored else 0
    changed = {"tuner_state": state, "searched": searched, "unsafe_in_a_row": unsafe}
    if unsafe >= UNSAFE_IN_A_ROW:
        end = f"the search ended after {UNSAFE_IN_A_ROW} unsafe trials in a row"
    elif searched >= session.plan.trials:
        end = f"the search used its {session.plan.trials} trials"
    else:
        return changed
    # The tuner's centre is its considered answer; the best single trial may be luck, or may not.
    points = (tuner.recommend(state), state.best_point)
    start = (session.plan.start,) if session.plan.repeat_start else ()
    candidates = tuple(dict.fromkeys((*start, *map(tuner.space.gains, points))))
    confirmed = ((),) * len(candidates)
    return {**changed, "search_end": end, "candidates": candidates, "confirmed": confirmed}


def _confirmed_with(session: Session, cost: float) -> tuple[tuple[float, ...], ...]:
    """The costs of the candidates with one more of the one that was asked for."""
    index = _unconfirmed(session)
    return tuple(
        (*costs, cost) if i == index else costs for i, costs in enumerate(session.confirmed)
    )


def _unconfirmed(session: Session) -> int | None:
    """Index of the candidate to be repeated next: the one with the fewest repeats."""
    fewest = min(map(len, session.confirmed))
    if fewest >= session.plan.repeats:
        return None
    return [len(costs) for costs in session.confirmed].index(fewest)


def _mean(costs: tuple[float, ...]) -> tuple[float, float]:
    """Mean and its standard error; infinite where any of the repeats was unsafe."""
    if not costs or not all(map(math.isfinite, costs)):
        return math.inf, 0.0
    return fmean(costs), math.sqrt(variance(costs) / len(costs)) if len(costs) > 1 else 0.0


def _unsafe_start(session: Session, outcome: Outcome, cost: float) -> str:
    what = (
        f"cost {cost:.3g} is over eta_max = {session.eta_max:.3g}"
        if outcome is Outcome.DONE
        else outcome.sentence
    )
    return (
        f"the start gains {session.plan.start} are unsafe on this rig: {what}; "
        "start from gentler gains (apply them to the rig first) or raise eta_max"
    )
