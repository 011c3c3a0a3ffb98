"""State machine of one tuning run: the trial history determines the next request.

A run has four phases. `baseline` runs the initial gains, and in `search` the tuner proposes.
Where the step trials leave the identified loop unknown, `excite` runs a multisine in between,
which has no cost (`estune.run.excitation`).
`choose` repeats the tuner's recommendation and its best trial, interleaved, unless the tuner
predicts costs by an identified loop; `confirm` repeats the better of the two and the initial
gains, interleaved, until the interval of the improvement is narrow. Choice and confirmation use
different trials, so that lucky costs in the choice do not bias the confirmed improvement. Trials
with the confirmed gains that show their limits may follow (`estune.run.showing_limits`). A search
by an identified loop is short and chooses by no cost, so that its baseline counts as the first
repeat of the initial gains. Nothing here reads a clock or a file: replaying a journal's trials
restores the session and all later proposals, bit for bit unless `estune.run.recorded` had to help.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

from estune.core.comparison import InterleavedRepeats
from estune.core.gains import Gains
from estune.loop_model.records import LoopRecord
from estune.run.confirmation import confirming, extended
from estune.run.excitation import ExcitationTrial, excitation_trial
from estune.run.phase import Phase
from estune.run.plan import CAUTION_TRIALS, EXCITATIONS, EXCITATIONS_MAX, Plan
from estune.run.tally import Tally, is_safe
from estune.trial import Outcome, RigDescription, TrialRequest
from estune.tuners.interface import CostPrediction, PredictingTuner, RecordUsingTuner
from estune.tuners.observation import Observation

CONSECUTIVE_CENSORED_MAX = 12
"""Consecutive unsafe or declined trials that end the search."""


@dataclass(frozen=True, slots=True)
class Session:
    """Immutable state of a run; `after_trial` returns its successor.

    Attributes:
        tally: What the trials count up to; its number is that of the next trial.
        attempt: Void attempts of the next trial.
        consecutive_censored: Search trials since the last safe one, unsafe or declined.
        consecutive_settled: Last search trials with a remaining improvement below the tolerance.
        excitation: The trial that excites the loop next; None for a step trial.
        excitations: Numbers of the completed trials of this kind.
        excitation_refused: Whether the rig refused one: it is not asked for another.
        search_end: Why the search ended; empty while it continues.
        choice: Repeats of the candidates; None before there are two.
        confirmation: Repeats of the initial and of the tuned gains, in this order, the first
            ones perhaps those of the baseline; None before there are any.
        showing: Trials after the confirmation that are foretold to show the limits, the next one
            included; zero without any.
        failure: Why the run cannot continue; empty while it can.
    """

    plan: Plan
    tuner_state: Any
    tally: Tally
    attempt: int = 0
    search_trials: int = 0
    consecutive_censored: int = 0
    consecutive_settled: int = 0
    excitation: ExcitationTrial | None = None
    excitations: tuple[int, ...] = ()
    excitation_refused: bool = False
    search_end: str = ""
    choice: InterleavedRepeats | None = None
    confirmation: InterleavedRepeats | None = None
    showing: int = 0
    failure: str = ""

    @property
    def number(self) -> int:
        """Number of the next trial."""
        return self.tally.number

    @property
    def unsafe(self) -> int:
        """Unsafe trials, in any phase."""
        return self.tally.unsafe

    @property
    def declined(self) -> int:
        """Declined trials."""
        return self.tally.declined

    @property
    def baseline(self) -> tuple[float, ...]:
        """Costs of the initial gains."""
        return self.tally.baseline

    @property
    def phase(self) -> Phase | None:
        """The phase of the next trial; None if there is none."""
        if self.failure:
            return None
        if len(self.baseline) < self.plan.baseline_trials:
            return Phase.BASELINE
        if self.excitation is not None:
            return Phase.EXCITE
        if not self.search_end:
            return Phase.SEARCH
        if self.confirmation is not None:
            return None if self.confirmation.next_index is None else Phase.CONFIRM
        return None if self.choice is None or self.choice.next_index is None else Phase.CHOOSE

    @property
    def eta_max(self) -> float:
        """The cost above which a trial is unsafe; infinite until there is a baseline."""
        return self.tally.eta_max

    @property
    def trials_left(self) -> int:
        """Expected number of trials to come."""
        repeats = self.plan.repeats
        if self.phase is None:
            return 0
        if self.confirmation is not None:
            return self.showing or self.confirmation.missing
        if self.choice is not None:
            return self.choice.missing + 2 * repeats
        to_come = self.plan.trials - self.search_trials + 2 * repeats
        to_come += -1 if self.plan.uses_records else 2 * repeats  # baseline or choice
        return to_come + self.plan.baseline_trials - len(self.baseline)

    @property
    def is_open(self) -> bool:
        """Whether the search decides how many trials are to come."""
        return not self.showing and self.phase in (Phase.BASELINE, Phase.EXCITE, Phase.SEARCH)

    @property
    def most_left(self) -> int:
        """Largest number of trials to come, void ones excluded, while that is open."""
        if not self.is_open:
            return self.trials_left
        excited = EXCITATIONS_MAX if self.excitation_refused else len(self.excitations)
        done = len(self.baseline) + self.search_trials + excited * self.plan.uses_records
        return self.plan.max_trials - done

    @property
    def recommendation(self) -> Gains:
        """The gains that the tuner recommended at the end of its search; else the initial ones."""
        if self.choice is not None:
            return self.choice.gains[0]
        return self.candidate or self.plan.start

    @property
    def candidate(self) -> Gains | None:
        """The gains in confirmation, or confirmed; None if there are none."""
        return None if self.confirmation is None else self.confirmation.gains[1]


def new_session(plan: Plan) -> Session:
    """The session before its first trial."""
    return Session(plan, plan.tuner.start(), Tally(plan.eta_max))


def extended_search(session: Session, trials: int) -> Session:
    """The session with another number of search trials; a search that has ended goes on."""
    return replace(
        session,
        plan=replace(session.plan, trials=trials),
        search_end="",
        choice=None,
        confirmation=None,
        showing=0,
        consecutive_settled=0,
        consecutive_censored=0,
    )


def next_request(session: Session) -> TrialRequest | None:
    """The next trial; None when the run is complete or has failed."""
    gains = _next_gains(session)
    if gains is None:
        return None
    plan, excitation = session.plan, session.excitation
    profile = plan.step if excitation is None else excitation.profile
    return TrialRequest(plan.run, session.number, gains, profile, session.attempt)


def predict_next(session: Session) -> CostPrediction | None:
    """The tuner's prediction of the next trial.

    None for gains that have been run before, as those of an excitation have, and if the tuner has
    no predictions.
    """
    gains, tuner = _next_gains(session), session.plan.tuner
    if gains is None or session.excitation or not isinstance(tuner, PredictingTuner):
        return None
    run_before = [session.plan.start]
    if session.tuner_state.best_cost is not None:
        run_before.append(tuner.space.gains(session.tuner_state.best_point))
    for repeats in (session.choice, session.confirmation):
        if repeats is not None:
            run_before += [
                g for g, costs in zip(repeats.gains, repeats.costs, strict=True) if costs
            ]
    if gains in run_before:
        return None
    return tuner.predict(session.tuner_state, tuner.space.point_of(gains))


def after_trial(
    session: Session,
    outcome: Outcome,
    cost: float,
    margin: float = math.inf,
    record: LoopRecord | None = None,
    *,
    reason: str = "",
) -> Session:
    """The session after the trial that `next_request` returned.

    The cost is ignored unless the trial is done; `margin` is its `constraint_margin`, `record`
    its signals if the plan uses them, `reason` its ending in words.
    """
    if outcome.is_void:
        return replace(session, attempt=session.attempt + 1)
    phase = session.phase
    assert phase is not None  # noqa: S101  a trial was asked for
    censored = not is_safe(phase, outcome, cost, session.eta_max)
    changed: dict[str, Any] = {}
    if phase is Phase.BASELINE and censored:
        changed = {"failure": _unsafe_start(session, outcome, cost, reason)}
    elif phase is Phase.BASELINE:
        if isinstance(session.plan.tuner, RecordUsingTuner):
            told = Observation(cost, margin=margin, record=record)
            changed["tuner_state"] = session.plan.tuner.tell_start(session.tuner_state, told)
    elif phase is Phase.EXCITE and outcome is Outcome.DECLINED:
        changed = {"excitation": None, "excitation_refused": True}
    elif phase is Phase.EXCITE:
        changed = _after_excitation(session, record)
    elif phase is Phase.SEARCH:
        observation = Observation(math.nan if censored else cost, censored, margin, record)
        changed = _after_search(session, observation)
    elif phase is Phase.CHOOSE and session.choice is not None:
        choice = session.choice.with_cost(math.inf if censored else cost)
        changed = {"choice": choice}
        if choice.next_index is None and choice.best is not None:
            changed["confirmation"] = confirming(
                session.plan, choice.gains[choice.best], known_costs(session)
            )
    else:
        changed = {"confirmation": _after_repeat(session, outcome, cost)}
    return replace(
        session, tally=session.tally.after([(phase, outcome, cost)]), attempt=0, **changed
    )


def _after_repeat(session: Session, outcome: Outcome, cost: float) -> InterleavedRepeats:
    """The confirmation after a repeat; one that shows limits does not open it again.

    The initial gains ran safely: a load that makes a slow loop's trial dear does not void it.
    """
    assert session.confirmation is not None  # noqa: S101  the last phase there is
    most = session.eta_max if session.confirmation.next_index else math.inf
    safe = is_safe(Phase.CONFIRM, outcome, cost, most)
    repeats = session.confirmation.with_cost(cost if safe else math.inf)
    return repeats if session.showing else extended(repeats, session.plan)


def _next_gains(session: Session) -> Gains | None:
    plan, phase = session.plan, session.phase
    if phase is None:
        return None
    if phase is Phase.BASELINE:
        return plan.start
    if session.excitation is not None:
        return session.excitation.gains
    if phase is Phase.SEARCH:
        return plan.tuner.space.gains(plan.tuner.ask(session.tuner_state))
    repeats = session.choice if phase is Phase.CHOOSE else session.confirmation
    assert repeats is not None and repeats.next_index is not None, phase  # noqa: S101, PT018
    return repeats.gains[repeats.next_index]


def _after_search(session: Session, observation: Observation) -> dict[str, Any]:
    """Fields of the session that a search trial changes."""
    plan = session.plan
    state = plan.tuner.tell(session.tuner_state, observation)
    settled = _is_settled(plan, state)
    changed = {
        "tuner_state": state,
        "search_trials": session.search_trials + 1,
        "consecutive_censored": session.consecutive_censored + 1 if observation.censored else 0,
        "consecutive_settled": session.consecutive_settled + 1 if settled else 0,
    }
    session = replace(session, **changed)
    end = _end_of_search(session)
    return changed | ({"search_end": end} | _after_end(session) if end else {})


def _is_settled(plan: Plan, state: Any) -> bool:
    """Whether the remaining improvement is below the tolerance."""
    found = plan.convergence(state) if plan.may_end(state) else None
    return found is not None and found.remaining_improvement < plan.tolerance


def _end_of_search(session: Session) -> str:
    """Why the search ends; empty where it continues."""
    plan, state = session.plan, session.tuner_state
    found = plan.convergence(state) if plan.may_end(state) else None
    if session.consecutive_censored >= CONSECUTIVE_CENSORED_MAX:
        censored = CONSECUTIVE_CENSORED_MAX
        return f"the search ended after {censored} consecutive unsafe or declined trials"
    if found is not None and session.consecutive_settled >= plan.settled_trials(state):
        below = f"below the tolerance of {100.0 * plan.tolerance:.3g}%"
        return f"the search ended: {found.sentence}, {below}"
    if plan.would_repeat(state):
        most = f"; {found.sentence}" if found and found.remaining_improvement < 1.0 else ""
        return f"the search ended: the next trial would repeat an earlier one{most}"
    if session.search_trials >= plan.trials:
        return f"the search used its {plan.trials} trial{'s' if plan.trials > 1 else ''}"
    return ""


def _after_end(session: Session) -> dict[str, Any]:
    """Fields of the session that the end of its search sets."""
    plan, state, tuner = session.plan, session.tuner_state, session.plan.tuner
    # The recommendation rests on all trials; the best single trial may be luck, or may not.
    points = [tuner.recommend(state)]
    if not plan.is_predicted(state):
        points.append(state.best_point)
    gains = tuple(map(tuner.space.gains, points))
    if not tuner.space.is_same(points[0], points[-1]):
        return {"choice": InterleavedRepeats.new(gains, plan.repeats)}
    return {"confirmation": confirming(plan, gains[0], known_costs(session))}


def with_excitation(session: Session, rig: RigDescription) -> Session:
    """The session with an excitation next, where one would tell more of the loop.

    Before each trial of the search, and before the confirmation of what it recommends. Not twice
    in a row, for a step trial in between may show enough, or better gains for another; but where
    it is known what the loop costs that is not known, as many as pay.
    """
    tuner, plan = session.plan.tuner, session.plan
    before, done = session.confirmation, len(session.excitations)
    confirmed = before is not None and before.costs != (known_costs(session), ())
    if session.phase not in (Phase.SEARCH, Phase.CONFIRM) or confirmed:
        return session
    if session.excitation_refused or not isinstance(tuner, RecordUsingTuner):
        return session
    unknown = tuner.unknown_loop(session.tuner_state)
    if unknown is None:
        return session
    if unknown.price is None:
        may = done < EXCITATIONS and session.number - 1 not in session.excitations
    else:
        to_come = 2 * plan.repeats - len(known_costs(session))
        may = done < EXCITATIONS_MAX and session.number + 1 + to_come <= CAUTION_TRIALS
    made = excitation_trial(unknown, plan, rig) if may else None
    return session if made is None else replace(session, excitation=made)


def _after_excitation(session: Session, record: LoopRecord | None) -> dict[str, Any]:
    """Fields of the session that an excitation changes; it is told nothing without a record.

    A search that had ended goes on where the loop, known better, has more to gain.
    """
    plan, state = session.plan, session.tuner_state
    changed: dict[str, Any] = {
        "excitation": None,
        "excitations": (*session.excitations, session.number),
    }
    if session.showing or record is None or not isinstance(plan.tuner, RecordUsingTuner):
        return changed
    state = plan.tuner.tell_excitation(state, record)
    changed["tuner_state"] = state
    if session.search_end:
        settled = plan.settled_trials(state) if _is_settled(plan, state) else 0
        changed |= {"confirmation": None, "choice": None, "consecutive_settled": settled}
        known = replace(session, **changed)
        changed["search_end"] = _end_of_search(known)
        if changed["search_end"]:
            changed |= _after_end(known)
    return changed


def known_costs(session: Session) -> tuple[float, ...]:
    """Costs of the initial gains before the confirmation that count as repeats of theirs."""
    return session.baseline if session.plan.is_predicted(session.tuner_state) else ()


def _unsafe_start(session: Session, outcome: Outcome, cost: float, reason: str) -> str:
    remedy = "start from gentler gains (apply them to the rig first)"
    if reason or outcome is not Outcome.DONE:
        what = reason or outcome.sentence
    elif cost > session.eta_max:
        what = f"cost {cost:.3g} is over eta_max = {session.eta_max:.3g}"
        remedy += " or raise eta_max"
    else:
        what = f"the trial has no cost above zero ({cost:.3g}); check its record"
    return f"the start gains {session.plan.start} are unsafe on this rig: {what}; {remedy}"
