"""One tuning run as a pure fold: what has been told decides what is asked next.

A run has four phases. `baseline` repeats the gains the rig came with, `search` lets the tuner
propose, `choose` repeats what the tuner recommends and the best trial it saw, in turn, and
`confirm` repeats the better of the two and the start, in turn. The choice is made by other trials
than the confirmation, so that the gains chosen do not look better than they are for having been
lucky. Nothing here reads a clock or a file, so replaying a journal's trials gives back the
session, and with it every later proposal, bit for bit.
"""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from statistics import fmean
from typing import Any

from estune.core.comparison import repeatability, repeats_needed
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.repeats import InterleavedRepeats
from estune.errors import InvalidInput
from estune.trial import Outcome, TrialRequest
from estune.trial.profiles import StepProfile
from estune.tuners import Tuner
from estune.tuners.interface import ConvergenceEstimate, CostPrediction, ModelBasedTuner
from estune.tuners.observation import Observation


class Phase(StrEnum):
    """Where a trial belongs in a run."""

    BASELINE = "baseline"
    SEARCH = "search"
    CHOOSE = "choose"
    CONFIRM = "confirm"


TOLERANCE = 0.02
"""What is left to gain when a search ends, unless the user says otherwise."""


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
        repeats: Trials of the start before the search, of each gains there are to choose from,
            and at the least of each in the confirmation.
        eta_max: A trial that costs more is unsafe (the paper's guard under (35)); None is
            `UNSAFE_RATIO` times the start's own cost.
        tolerance: The search ends once no more than this share of the cost is left to gain, by a
            tuner that can tell; zero makes it use all its trials.
        ask_first: Whether somebody has to agree before gains are tried that lie beyond what safe
            trials have shown to be safe.

    Raises:
        InvalidInput: a count is too small, the limit is not above zero, the tolerance is not a
            share, the tuner can't tell what is known to be safe, or the settling time is longer
            than the trial.
    """

    run: str
    tuner: Tuner[Any]
    start: Gains
    step: StepProfile
    cost: StepCost
    trials: int = 120
    repeats: int = 3
    eta_max: float | None = None
    tolerance: float = TOLERANCE
    ask_first: bool = False

    def __post_init__(self) -> None:
        if self.trials < 1 or self.repeats < 1:
            raise InvalidInput(
                f"{self.trials} search trials with {self.repeats} repeats: each must be at least 1"
            )
        if self.eta_max is not None and not (math.isfinite(self.eta_max) and self.eta_max > 0.0):
            raise InvalidInput(f"eta_max is {self.eta_max}; it must be finite and above zero")
        if not 0.0 <= self.tolerance < 1.0:
            raise InvalidInput(
                f"tolerance is {self.tolerance}; it is a share of the cost, from 0 (use all "
                "trials) to below 1, such as 0.02"
            )
        if self.ask_first and not isinstance(self.tuner, ModelBasedTuner):
            raise InvalidInput(
                f"tuner {self.tuner.name} cannot tell what is known to be safe, so that there is "
                "nothing to ask by; use safe_bayesian"
            )
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
        """The greatest number of trials the run may take, void ones aside."""
        return self.trials + 3 * self.repeats + 2 * max(ROUNDS_MOST, self.repeats)

    def outlook(self, tuner_state: Any) -> ConvergenceEstimate | None:
        """Where the search stands, by a tuner that can tell and knows enough."""
        tuner = self.tuner
        return tuner.convergence(tuner_state) if isinstance(tuner, ModelBasedTuner) else None


UNSAFE_RATIO = 3.0
"""A trial that costs this many times the start is unsafe, unless the user says otherwise."""

CENSORED_IN_A_ROW = 12
"""So many trials in a row unsafe or declined end the search: it is not finding its way back."""

SETTLED_IN_A_ROW = 4
"""So many trials in a row after which too little is left to gain end the search."""

ROUNDS_MOST = 10
"""Most repeats of each gains in a confirmation, unless the plan asks for more."""


@dataclass(frozen=True, slots=True)
class Session:
    """Where a run stands: a value that `told` turns into the next one.

    Attributes:
        plan: What decides the run.
        tuner_state: The tuner's own state.
        number: Number of the trial to be asked next.
        attempt: How often that trial was void.
        searched: Search trials told.
        unsafe: Unsafe trials told, in any phase.
        declined: Trials that were declined.
        censored_in_a_row: Search trials since the last safe one, unsafe or declined.
        settled_in_a_row: Search trials after each of which too little was left to gain.
        baseline: Costs of the start gains.
        search_end: Why the search ended; empty while it goes on.
        choice: Repeats of the gains to choose from; None before there are two.
        confirmation: Repeats of the start and of the gains found, in this order; None before
            there are any.
        failure: Why the run can't go on at all; empty while it can.
    """

    plan: Plan
    tuner_state: Any
    number: int = 0
    attempt: int = 0
    searched: int = 0
    unsafe: int = 0
    declined: int = 0
    censored_in_a_row: int = 0
    settled_in_a_row: int = 0
    baseline: tuple[float, ...] = ()
    search_end: str = ""
    choice: InterleavedRepeats | None = None
    confirmation: InterleavedRepeats | None = None
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
        if self.confirmation is not None:
            return None if self.confirmation.next_index is None else Phase.CONFIRM
        return None if self.choice is None or self.choice.next_index is None else Phase.CHOOSE

    @property
    def eta_max(self) -> float:
        """The cost above which a trial is unsafe; infinite until there is a baseline."""
        if self.plan.eta_max is not None:
            return self.plan.eta_max
        return UNSAFE_RATIO * fmean(self.baseline) if self.baseline else math.inf

    @property
    def trials_left(self) -> int:
        """The trials still to come if nothing ends a phase early or draws it out."""
        repeats = self.plan.repeats
        if self.phase is None:
            return 0
        if self.confirmation is not None:
            return self.confirmation.missing
        if self.choice is not None:
            return self.choice.missing + 2 * repeats
        return self.plan.trials - self.searched + 5 * repeats - len(self.baseline)

    @property
    def candidate(self) -> Gains | None:
        """The gains that are being, or were, confirmed; None if there are none."""
        return None if self.confirmation is None else self.confirmation.gains[1]


def new_session(plan: Plan) -> Session:
    """The session before its first trial."""
    return Session(plan, plan.tuner.start())


def next_request(session: Session) -> TrialRequest | None:
    """The trial to be run next, or None when the run is complete or has failed."""
    gains = _next_gains(session)
    if gains is None:
        return None
    plan = session.plan
    return TrialRequest(plan.run, session.number, gains, plan.step, session.attempt)


def forecast(session: Session) -> CostPrediction | None:
    """What the tuner expects of the trial to be run next.

    None for gains that have been run before, and with a tuner that cannot tell.
    """
    gains, tuner = _next_gains(session), session.plan.tuner
    if gains is None or not isinstance(tuner, ModelBasedTuner):
        return None
    known = [session.plan.start]
    if session.tuner_state.best_cost is not None:
        known.append(tuner.space.gains(session.tuner_state.best_point))
    for repeats in (session.choice, session.confirmation):
        if repeats is not None:
            known += [g for g, costs in zip(repeats.gains, repeats.costs, strict=True) if costs]
    if gains in known:
        return None
    return tuner.predict(session.tuner_state, tuner.space.point_of(gains))


def is_censored(session: Session, outcome: Outcome, cost: float) -> bool:
    """Whether the trial told nothing but to keep away from its gains: the guard `eta < eta_max`.

    A cost that is not above zero is none: (35) has none such.
    """
    return outcome is not Outcome.DONE or not 0.0 < cost <= session.eta_max or math.isinf(cost)


def is_unsafe(session: Session, outcome: Outcome, cost: float) -> bool:
    """Whether the trial was unsafe: censored for what it did, and not for not having been run."""
    return (
        is_censored(session, outcome, cost)
        and outcome is not Outcome.DECLINED
        and not outcome.is_void
    )


def after_trial(
    session: Session, outcome: Outcome, cost: float, margin: float = math.inf
) -> Session:
    """The session after the trial it asked for.

    Args:
        session: Where the run stood.
        outcome: How the trial ended.
        cost: Its cost eta; ignored unless the trial is done.
        margin: The smallest share it left of any of the rig's limits.
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
        seen = Observation(math.nan if censored else cost, censored, margin)
        changed = _after_search(session, seen)
    elif phase is Phase.CHOOSE and session.choice is not None:
        choice = session.choice.with_cost(math.inf if censored else cost)
        changed = {"choice": choice}
        if choice.next_index is None and choice.best is not None:
            gains, costs = choice.gains[choice.best], choice.costs[choice.best]
            expected = fmean(costs) if costs else math.nan
            changed["confirmation"] = _confirmation(session, gains, expected, choice.costs)
    else:
        assert session.confirmation is not None, phase  # noqa: S101  the last phase there is
        changed = {"confirmation": session.confirmation.with_cost(math.inf if censored else cost)}
    return replace(
        session,
        number=session.number + 1,
        attempt=0,
        unsafe=session.unsafe + is_unsafe(session, outcome, cost),
        declined=session.declined + (outcome is Outcome.DECLINED),
        **changed,
    )


def _next_gains(session: Session) -> Gains | None:
    plan, phase = session.plan, session.phase
    if phase is None:
        return None
    if phase is Phase.BASELINE:
        return plan.start
    if phase is Phase.SEARCH:
        return plan.tuner.space.gains(plan.tuner.ask(session.tuner_state))
    repeats = session.choice if phase is Phase.CHOOSE else session.confirmation
    assert repeats is not None and repeats.next_index is not None, phase  # noqa: S101, PT018
    return repeats.gains[repeats.next_index]


def _after_search(session: Session, observation: Observation) -> dict[str, Any]:
    """What a search trial changes."""
    plan = session.plan
    tuner = plan.tuner
    state = tuner.tell(session.tuner_state, observation)
    outlook = plan.outlook(state) if plan.tolerance else None
    settled = outlook is not None and outlook.remaining_improvement < plan.tolerance
    changed = {
        "tuner_state": state,
        "searched": session.searched + 1,
        "censored_in_a_row": session.censored_in_a_row + 1 if observation.censored else 0,
        "settled_in_a_row": session.settled_in_a_row + 1 if settled else 0,
    }
    if changed["censored_in_a_row"] >= CENSORED_IN_A_ROW:
        end = f"the search ended after {CENSORED_IN_A_ROW} unsafe or declined trials in a row"
    elif outlook is not None and changed["settled_in_a_row"] >= SETTLED_IN_A_ROW:
        end = (
            f"the search ended after {changed['searched']} of {plan.trials} trials: "
            f"at most {outlook.remaining_improvement:.1%} is left to gain, under the tolerance of "
            f"{100.0 * plan.tolerance:.3g}%"
        )
    elif changed["searched"] >= plan.trials:
        end = f"the search used its {plan.trials} trial{'s' if plan.trials > 1 else ''}"
    else:
        return changed
    changed["search_end"] = end
    # The tuner's answer is a considered one; the best single trial may be luck, or may not.
    points = (tuner.recommend(state), state.best_point)
    gains = tuple(dict.fromkeys(map(tuner.space.gains, points)))
    if len(gains) > 1:
        changed["choice"] = InterleavedRepeats.of(gains, plan.repeats)
    else:
        ended = replace(session, tuner_state=state)
        expected = math.nan if state.best_cost is None else state.best_cost
        changed["confirmation"] = _confirmation(ended, gains[0], expected)
    return changed


def _confirmation(
    session: Session,
    gains: Gains,
    expected: float,
    costs: tuple[tuple[float, ...], ...] = (),
) -> InterleavedRepeats | None:
    """The repeats that tell what the gains found gain; None where they are the start.

    Args:
        session: The run, its search over.
        gains: The gains found.
        expected: What they are likely to cost; nan if that is not known.
        costs: Repeats there have been beside the baseline.
    """
    plan = session.plan
    if gains == plan.start:
        return None
    outlook = plan.outlook(session.tuner_state)
    noise = repeatability((session.baseline, *costs)) if outlook is None else outlook.noise
    rounds = repeats_needed(
        math.log(expected / fmean(session.baseline)),
        noise,
        least=plan.repeats,
        most=ROUNDS_MOST,
    )
    return InterleavedRepeats.of((plan.start, gains), rounds)


def _unsafe_start(session: Session, outcome: Outcome, cost: float) -> str:
    if outcome is not Outcome.DONE:
        what = outcome.sentence
    elif cost > session.eta_max:
        what = f"cost {cost:.3g} is over eta_max = {session.eta_max:.3g}"
    else:
        what = f"the trial has no cost above zero ({cost:.3g}): look at its record"
    return (
        f"the start gains {session.plan.start} are unsafe on this rig: {what}; "
        "start from gentler gains (apply them to the rig first) or raise eta_max"
    )
