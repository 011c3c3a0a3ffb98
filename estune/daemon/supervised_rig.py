"""Thread-safe supervision of one rig: its state, commands to it, and results that change it.

The next state is committed together with its event, under one lock, before it becomes the state.
The supervisor's thread is woken by `changed`; no caller waits for it.
"""

import logging
import math
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Unpack

from estune.core.control_chart import ChartSignal
from estune.core.gains import Gains
from estune.daemon.behaviour_checks import BehaviourChecks
from estune.daemon.check_trials import CheckTrials
from estune.daemon.config import RigTable
from estune.daemon.events import EventKind
from estune.daemon.faults import FAULT, EventFacts, FaultCode
from estune.daemon.margin_watch import MarginReport, MarginWatch
from estune.daemon.store import CommandResult, DaemonStore, now
from estune.daemon.supervisor_state import (
    GainSet,
    SupervisorEvent,
    SupervisorMode,
    SupervisorState,
    next_state,
)
from estune.daemon.tuning_runs import RunDecision, TuningRuns
from estune.errors import EstuneError, InvalidInput, JournalError
from estune.remote.messages.daemon import (
    Command,
    CommandAnswer,
    DaemonEvent,
    DaemonStatus,
    DaemonVerb,
    Events,
    History,
    Request,
)
from estune.run.session import Session
from estune.trial import Outcome

EventListener = Callable[[DaemonEvent], None]
"""Callback after each committed event; must return at once."""

# A rig may stay away for days: each try would run the hooks, and push other events out of store.
_TOLD_ONCE = (SupervisorEvent.LOST, SupervisorEvent.FAILED, SupervisorEvent.TROUBLE)

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class RigCounts:
    """Counts of one rig.

    Attributes:
        trials: Trials by outcome; those that no record could be had of are not among them.
        trial_s: Time of these trials together, from the request to the record.
        leases_lost: Leases that ended during a trial.
        commands_refused: Commands of operators that the mode did not allow.
    """

    trials: Counter[str] = field(default_factory=Counter)
    trial_s: float = 0.0
    leases_lost: int = 0
    commands_refused: int = 0
    faults: Counter[str] = field(default_factory=Counter)

    def note_trial(self, outcome: Outcome, took_s: float) -> None:
        """Counts a trial."""
        self.trials[outcome.value] += 1
        self.trial_s += took_s


class Preempted(Exception):
    """An event pre-empted the current activity."""


class SupervisedRig:
    """Supervision of one rig.

    Attributes:
        changed: Set whenever the supervisor may have to do something else.
        live: The gain set that the rig has confirmed to be live; None while unknown.
        session: The tuning run of this process, current or last.
        cost: Cost of the last trial, if it had one.
        refused: Why this rig is left alone: another daemon has it; empty otherwise.
        waits_for: What is waited for, where the mode does not say it; empty otherwise.
        abort_trial: Ends the trial under way, if any, without waiting.
    """

    def __init__(
        self, store: DaemonStore, settings: RigTable, instance: str, listener: EventListener
    ) -> None:
        self.name = store.rig
        self.store = store
        self.tuning_runs = TuningRuns(store, settings)
        self.checks = CheckTrials(store, settings)
        self.margins = MarginWatch(settings, f"{store.identity}-{instance}")
        self.behaviour = BehaviourChecks(store, settings)
        self.changed = threading.Event()
        self.live: GainSet | None = None
        self.session: Session | None = None
        self._earlier_trials = self.tuning_runs.counts()
        self.cost: float | None = None
        self.refused = ""
        self.waits_for = ""
        self.abort_trial: Callable[[], None] = lambda: None
        self.counts = RigCounts()
        self._instance, self._listener = instance, listener
        self._since = now()
        self._lock = threading.RLock()
        self._state = next_state(store.state, SupervisorEvent.BOOT)
        self._status: tuple[object, DaemonStatus | None] = None, None

    @property
    def state(self) -> SupervisorState:
        """The state, as committed."""
        return self._state

    @property
    def mode(self) -> SupervisorMode:
        """The supervisor's present activity."""
        return self._state.mode

    def command(self, verb: DaemonVerb, command: Command) -> CommandAnswer:
        """Accepts or refuses a command, once for each id; the supervisor's thread executes it."""
        reason = f"{verb} by {command.who}" + (f": {command.why}" if command.why else "")
        with self._lock:
            result = self.store.command(command.command_id)
            if result is None:
                result = self._take(SupervisorEvent(verb), command, reason)
        if result.done:
            self.changed.set()
        if result.done and verb in ("stop", "revert"):
            self.abort_trial()
        return CommandAnswer(result.done, result.sentence)

    def status(self) -> DaemonStatus:
        """Mode, gain sets, costs and drift; what is stored is read again where it has changed."""
        session, state = self.session, self._state
        made_of, made = self._status
        if made is None or made_of != (self.store.changes, state):
            made_of, made = (self.store.changes, state), self._stored_status(state)
        present: dict[str, Any] = {
            "sentence": self.refused or self.waits_for or state.mode.sentence,
            "live": self.live.value if self.live else "",
            "trials": session.number if session else self._earlier_trials[0],
            "trials_max": session.plan.max_trials if session else self._earlier_trials[1],
            "cost": self.cost,
            "sensitivity": self.margins.bounds,
            "margins": self.margins.sentence,
            **self.behaviour.status,
        }
        if made.next_check_s is not None:
            present["next_check_s"] = self.checks.wait_s(state.home)
        if any(getattr(made, name) != value for name, value in present.items()):
            made = replace(made, **present)
        self._status = made_of, made  # at once: several threads ask
        return made

    def _stored_status(self, state: SupervisorState) -> DaemonStatus:
        """The status, complete but for what is not stored."""
        with self._lock:
            gains, candidate = self.store.gains(), GainSet.CANDIDATE
            chart, checks = self.checks.chart(state.home), self.store.checks(1)
            is_watched = state.mode is SupervisorMode.WATCHING and chart is not None
            return DaemonStatus(
                rig=self.name,
                instance=self._instance,
                mode=state.mode.value,
                sentence="",
                paused=state.paused,
                trouble=state.trouble,
                live="",
                home=state.home.value,
                why=state.why,
                gains={name.value: values for name, values in gains.items()},
                found=self.store.why(candidate) if candidate in gains else "",
                run=self.tuning_runs.name,
                trials=0,
                trials_max=0,
                baseline_cost=None if chart is None else math.exp(chart.mean),
                cost=None,
                drift=self.checks.drift(state.home),
                checks=checks[0].number + 1 if checks else 0,
                next_check_s=0.0 if is_watched else None,
                since=self._since,
            )

    def history(self, request: Request) -> History:
        """Gain sets, commands and check trials."""
        limit = request.limit
        checks = [check._asdict() for check in self.store.checks(limit)]
        return History(self.store.gain_history(limit), self.store.commands(limit), checks)

    def events(self, request: Request) -> Events:
        """Stored events."""
        return Events(self.store.events(request.after, request.limit))

    def mark_ready(self, live: GainSet | None) -> None:
        """Reports that the rig runs the nominal gains; None where an operator is needed first.

        Nothing is reported where those have changed meanwhile.
        """
        with self._lock:
            if self.mode is SupervisorMode.READYING and (live is None or self.state.home is live):
                self.live = live
                self._change(SupervisorEvent.READIED)

    def note_live(self, gains: Gains) -> None:
        """Takes the gains that a rig runs whose supervision is paused: others may set them."""
        with self._lock:
            home, stored = self.state.home, self.store.gains()
            live = next((name for name in (home, *GainSet) if stored.get(name) == gains), None)
            if self.mode is not SupervisorMode.PAUSED or live is self.live:
                return
            self.live = live
        if live is not home:
            sentence = f"the rig runs {gains}, set by others; resume applies the {home} gains"
            self.log_event(EventKind.GAINS, sentence, gains=str(gains))

    def stop(self, why: str) -> None:
        """Ends the supervision with the nominal gains restored, as the verb does."""
        with self._lock:
            if self.mode not in (SupervisorMode.STOPPING, SupervisorMode.STOPPED):
                self._change(SupervisorEvent.STOP, why, why)
        self.abort_trial()

    def apply_event(
        self,
        event: SupervisorEvent,
        reason: str,
        write: Callable[[], None] | None = None,
        *,
        sentence: str = "",
        **facts: Unpack[EventFacts],
    ) -> None:
        """Commits an event with what `write` stores along.

        Raises:
            Preempted: a command has changed the state meanwhile, and the event does not apply.
        """
        with self._lock:
            state = self._state
            try:
                next_state(state, event, reason)
            except EstuneError as error:
                _log.debug("%s", error)
                raise Preempted from None
            is_repeated = event in _TOLD_ONCE and reason in (state.trouble, state.paused)
            told = "" if is_repeated else sentence or reason
            self._change(event, reason, told, write, **facts)

    def note_cost(self, cost: float) -> None:
        """Takes the cost of the last trial, if it had one."""
        self.cost = cost if math.isfinite(cost) else None

    def log_event(self, kind: EventKind, sentence: str, **facts: Unpack[EventFacts]) -> None:
        """Stores and publishes an event that does not change the state."""
        with self._lock:
            try:
                event = self.store.add_event(kind, sentence, facts)
            except JournalError as error:
                event = self._unwritten(error, kind, sentence, facts)
        self._tell(event)

    def _tell(self, event: DaemonEvent) -> None:
        if fault := event.facts.get(FAULT):
            self.counts.faults[str(fault)] += 1
        self._listener(event)

    def apply_decision(self, decision: RunDecision, *, accept: bool) -> None:
        """Applies the result of a tuning run: better gains are accepted, or await a decision."""
        sentence, better = decision.sentence, decision.better
        if better is None and decision.start_chart is None:
            self.revert_to_original(f"repeats of the live gains were unsafe; {sentence}")
            return

        def write() -> None:
            self.tuning_runs.end()
            charts = {self.state.home: decision.start_chart, GainSet.CANDIDATE: decision.chart}
            self.checks.set_charts(charts)
            if better is not None:
                self.store.set_gains(GainSet.CANDIDATE, better, sentence)
                if accept:
                    self._store_accepted(sentence)

        if better is None:
            self.apply_event(SupervisorEvent.KEPT, sentence, write)
        else:
            event = SupervisorEvent.ADOPTED if accept else SupervisorEvent.PROPOSED
            self.apply_event(event, sentence, write, gains=str(better))

    def inherit(self, gains: Gains, reason: str) -> None:
        """Takes over the gains that another daemon left, as accepted ones without a baseline."""

        def write() -> None:
            self.store.set_gains(GainSet.CANDIDATE, None)
            self.store.set_gains(GainSet.ACCEPTED, gains, reason)
            self.tuning_runs.end()
            self.checks.set_charts({})

        self.apply_event(SupervisorEvent.INHERITED, reason, write, gains=str(gains))

    def revert_to_original(self, reason: str) -> None:
        """Replaces unsafe nominal gains by the original ones, and pauses."""
        write = self._drop_all_but_original
        self.apply_event(SupervisorEvent.UNSAFE, reason, write, fault=FaultCode.UNSAFE_GAINS)

    def handle_drift(self, cost: float, signal: ChartSignal) -> None:
        """Tunes again after a drift of the cost, unless the last tuning ended only recently."""
        if math.isinf(cost):
            reason = f"two check trials of the {self.state.home} gains in a row were unsafe"
            self.revert_to_original(reason)
        elif self.checks.is_cooldown_over:
            sentence = f"{signal.sentence}; tuning again"
            self.apply_event(SupervisorEvent.DRIFTED, sentence, fault=FaultCode.DRIFT)

    def handle_margins(self, reports: list[MarginReport]) -> None:
        """Logs what the margins show, and tunes again as after a drift where gains may mend it."""
        for report in reports:
            facts: EventFacts = {"gains": str(report.gains)} if report.gains is not None else {}
            self.log_event(report.kind, report.sentence, **facts)
        worse = [r for r in reports if r.kind is not EventKind.DITHER and not r.is_machine]
        if worse and self.checks.is_cooldown_over:
            sentence = f"{worse[0].sentence}; tuning again"
            self.apply_event(SupervisorEvent.DRIFTED, sentence, fault=FaultCode.DRIFT)

    def _take(self, event: SupervisorEvent, command: Command, reason: str) -> CommandResult:
        verb = event.value
        try:
            after = next_state(self._state, event, reason)
        except InvalidInput as error:
            self.counts.commands_refused += 1
            refused = CommandResult(done=False, sentence=str(error))
            self.store.add_command(command.command_id, verb, command.who, refused)
            return refused
        now_doing = f"{reason}; now {after.mode}: {after.mode.sentence}"
        result = CommandResult(done=True, sentence=now_doing)

        def write() -> None:
            match event:
                case SupervisorEvent.ACCEPT:
                    self._store_accepted(reason)
                case SupervisorEvent.REJECT:
                    self.store.set_gains(GainSet.CANDIDATE, None)
                case SupervisorEvent.REVERT:
                    self._drop_all_but_original()
                    self.store.set_fact("overrule", now())
                case SupervisorEvent.RESUME:
                    self.store.set_fact("overrule", now())
            self.store.add_command(command.command_id, verb, command.who, result)

        self._change(event, reason, reason, write)
        return result

    def _store_accepted(self, why: str) -> None:
        """The candidate becomes the accepted gains, with its control chart."""
        self.store.set_gains(GainSet.ACCEPTED, self.store.gains()[GainSet.CANDIDATE], why)
        self.store.set_gains(GainSet.CANDIDATE, None)
        self.checks.set_charts({GainSet.ACCEPTED: self.checks.chart(GainSet.CANDIDATE)})

    def _drop_all_but_original(self) -> None:
        self.store.set_gains(GainSet.CANDIDATE, None)
        self.store.set_gains(GainSet.ACCEPTED, None)
        self.tuning_runs.end()

    def _change(
        self,
        event: SupervisorEvent,
        reason: str = "",
        sentence: str = "",
        write: Callable[[], None] | None = None,
        **facts: Unpack[EventFacts],
    ) -> None:
        """Commits the next state and what `write` stores, and logs the sentence; the lock is held.

        A full disk must not keep a rig from being made safe: such an event takes effect all the
        same, and the state is written with the next.
        """
        before, logged, kind = self._state, None, event.kind
        after = next_state(before, event, reason)
        try:
            with self.store.transaction():
                if write is not None:
                    write()
                self.store.state = after
                if kind is not None and sentence:
                    logged = self.store.add_event(kind, sentence, facts)
        except JournalError as error:
            if event.needs_disk:
                raise
            logged = self._unwritten(error, kind or EventKind.FAILED, sentence or reason, facts)
        self._state = after
        if after.mode is not before.mode or after.home is not before.home:
            self.changed.set()
        if logged is not None:
            self._tell(logged)

    def _unwritten(
        self, error: JournalError, kind: EventKind, sentence: str, facts: EventFacts
    ) -> DaemonEvent:
        _log.error("not written: %s", error, extra={"rig": self.name})
        return DaemonEvent(self.name, 0, now(), kind, sentence, dict(facts))
