"""The state of one rig's supervision: asked, told and moved by any thread, kept on disk.

Whoever moves it does so under one lock: the next state is committed together with its event, and
only then is it the state. The keeper's thread is woken by it; nobody waits for the keeper.
"""

import logging
import math
import threading
from collections.abc import Callable

from estune.core.gains import Gains
from estune.daemon.check_trials import CheckTrials
from estune.daemon.events import Event, EventKind
from estune.daemon.store import CommandResult, DaemonStore, now
from estune.daemon.supervisor_state import (
    GainSet,
    SupervisorEvent,
    SupervisorMode,
    SupervisorState,
    next_state,
)
from estune.daemon.tuning_runs import TuningRuns
from estune.errors import EstuneError, InvalidInput, JournalError
from estune.remote.messages.daemon import (
    Command,
    CommandAnswer,
    DaemonStatus,
    DaemonVerb,
    EventMessage,
    Events,
    History,
    Request,
)
from estune.run.session import Session

Teller = Callable[[Event], None]
"""Told of each event after it was committed; must return at once."""

_log = logging.getLogger(__name__)


class Preempted(Exception):
    """Something else is to be done now than what was being done."""


class SupervisedRig:
    """Where the supervision of one rig stands.

    Attributes:
        name: The rig.
        store: Where it is kept.
        searches: Its tuning runs.
        checks: Its check trials.
        changed: Set whenever something else may have to be done.
        live: The gain set that the rig has confirmed to be live; None while it is not known.
        session: The tuning run under way, or the last of this process.
        cost: Cost of the last trial told, if it had one.
        refused: Why this rig must be left alone: another daemon has it; empty otherwise.
        cut: Ends the trial under way, if any, without making anybody wait.
    """

    def __init__(
        self,
        store: DaemonStore,
        searches: TuningRuns,
        checks: CheckTrials,
        instance: str,
        tell: Teller,
    ) -> None:
        self.name = store.rig
        self.store = store
        self.searches = searches
        self.checks = checks
        self.changed = threading.Event()
        self.live: GainSet | None = None
        self.session: Session | None = None
        self.cost: float | None = None
        self.refused = ""
        self.cut: Callable[[], None] = _nothing
        self._instance = instance
        self._tell = tell
        self._since = now()
        self._lock = threading.RLock()
        self._life = next_state(store.life, SupervisorEvent.BOOT)

    @property
    def life(self) -> SupervisorState:
        """The state."""
        return self._life

    @property
    def mode(self) -> SupervisorMode:
        """What is to be done now."""
        return self._life.mode

    def command(self, verb: DaemonVerb, command: Command) -> CommandAnswer:
        """Takes a command; the keeper's own thread carries it out."""
        words = f"{verb} by {command.who}" + (f": {command.why}" if command.why else "")
        with self._lock:
            done = self.store.command(command.command_id)
            if done is None:
                done = self._take(verb, command, words)
        if done.done:
            self.changed.set()
        if done.done and verb in ("stop", "revert"):
            self.cut()
        return CommandAnswer(done.done, done.sentence)

    def status(self) -> DaemonStatus:
        """What is done now, and which gains are live."""
        with self._lock:
            life, gains = self._life, self.store.gains()
            chart = self.checks.chart(life.home)
            watched = life.mode is SupervisorMode.WATCHING and chart is not None
            session, candidate = self.session, GainSet.CANDIDATE
            checks = self.store.checks(1)
            return DaemonStatus(
                rig=self.name,
                instance=self._instance,
                mode=life.mode.value,
                sentence=self.refused or life.mode.sentence,
                paused=life.paused,
                trouble=life.trouble,
                live=self.live.value if self.live else "",
                home=life.home.value,
                why=life.why,
                gains={name.value: values for name, values in gains.items()},
                found=self.store.why(candidate) if candidate in gains else "",
                run=self.searches.name,
                trials=session.number if session else 0,
                trials_max=session.plan.most_trials if session else 0,
                baseline_cost=None if chart is None else math.exp(chart.mean),
                cost=self.cost,
                drift=self.checks.drift(life.home),
                checks=checks[0].number + 1 if checks else 0,
                next_check_s=self.checks.wait_s(life.home) if watched else None,
                since=self._since,
            )

    def history(self, request: Request) -> History:
        """What was done."""
        limit = request.limit
        checks = [check._asdict() for check in self.store.checks(limit)]
        return History(self.store.gain_history(limit), self.store.commands(limit), checks)

    def events(self, request: Request) -> Events:
        """What has happened."""
        return Events(
            [
                EventMessage(e.rig, e.number, e.at, e.kind.value, e.sentence, e.facts)
                for e in self.store.events(request.after, request.limit)
            ]
        )

    def readied(self, live: GainSet | None) -> None:
        """The rig runs the home gains, unless those have changed meanwhile.

        Args:
            live: Which those are; None where somebody must see to the rig first.
        """
        with self._lock:
            if self.mode is SupervisorMode.READYING and (live is None or self._life.home is live):
                self.live = live
                self._move(SupervisorEvent.READIED)

    def stop(self, why: str) -> None:
        """Has the home gains put back and the supervision end; as the verb does."""
        with self._lock:
            if self.mode not in (SupervisorMode.STOPPING, SupervisorMode.STOPPED):
                self._move(SupervisorEvent.STOP, why, EventKind.STOPPING)
        self.cut()

    def accept(self, gains: Gains, why: str) -> None:
        """Writes that the candidate is accepted, with the chart that it has."""
        self.store.set_gains(GainSet.ACCEPTED, gains, why)
        self.store.set_gains(GainSet.CANDIDATE, None)
        self.checks.set_charts({GainSet.ACCEPTED: self.checks.chart(GainSet.CANDIDATE)})

    def apply_event(
        self,
        happening: SupervisorEvent,
        words: str,
        kind: EventKind,
        write: Callable[[], None] | None = None,
        *,
        sentence: str = "",
        **facts: object,
    ) -> None:
        """Moves the life on, unless a command has turned it elsewhere meanwhile."""
        with self._lock:
            try:
                next_state(self._life, happening, words)
            except EstuneError as error:
                _log.debug("%s", error)
                raise Preempted from None
            repeated = happening in (
                SupervisorEvent.LOST,
                SupervisorEvent.FAILED,
                SupervisorEvent.TROUBLE,
            ) and (words in (self._life.trouble, self._life.paused))
            self._move(happening, words, None if repeated else kind, sentence, write, **facts)

    def note(self, kind: EventKind, sentence: str, **facts: object) -> None:
        """Notes and tells an event that changes nothing."""
        with self._lock:
            try:
                event = self.store.note(kind, sentence, dict(facts))
            except JournalError as error:
                _log.error("not written: %s", error, extra={"rig": self.name})
                event = Event(self.name, 0, now(), kind, sentence, dict(facts))
        self._tell(event)

    def _take(self, verb: DaemonVerb, command: Command, words: str) -> CommandResult:
        happening = SupervisorEvent(verb)
        try:
            after = next_state(self._life, happening, words)
        except InvalidInput as error:
            done = CommandResult(done=False, sentence=str(error))
            self.store.note_command(command.command_id, verb, command.who, done)
            return done
        done = CommandResult(
            done=True, sentence=f"{words}; now {after.mode}: {after.mode.sentence}"
        )

        def write() -> None:
            gains = self.store.gains()
            match happening:
                case SupervisorEvent.ACCEPT:
                    self.accept(gains[GainSet.CANDIDATE], words)
                case SupervisorEvent.REJECT:
                    self.store.set_gains(GainSet.CANDIDATE, None)
                case SupervisorEvent.REVERT:
                    self.store.set_gains(GainSet.CANDIDATE, None)
                    self.store.set_gains(GainSet.ACCEPTED, None)
                    self.searches.end()
                    self.store.put("overrule", now())
                case SupervisorEvent.RESUME:
                    self.store.put("overrule", now())
            self.store.note_command(command.command_id, verb, command.who, done)

        kind = {
            SupervisorEvent.PAUSE: EventKind.PAUSED,
            SupervisorEvent.RESUME: EventKind.RESUMED,
            SupervisorEvent.STOP: EventKind.STOPPING,
        }.get(happening, EventKind.COMMAND)
        self._move(happening, words, kind, words, write)
        return done

    def _move(
        self,
        happening: SupervisorEvent,
        words: str = "",
        kind: EventKind | None = None,
        sentence: str = "",
        write: Callable[[], None] | None = None,
        **facts: object,
    ) -> None:
        """Commits the next state with its event and whatever is written along; the lock is held.

        A disk that is full must not keep a rig from being made safe: such a step is taken all the
        same, and written with the next.
        """
        before, event = self._life, None
        after = next_state(before, happening, words)
        try:
            with self.store.writing():
                if write is not None:
                    write()
                self.store.life = after
                if kind is not None:
                    event = self.store.note(kind, sentence or words, dict(facts))
        except JournalError as error:
            if happening not in _SAFE:
                raise
            _log.error("not written: %s", error, extra={"rig": self.name})
            event = Event(
                self.name, 0, now(), kind or EventKind.FAILED, sentence or words, dict(facts)
            )
        self._life = after
        if after.mode is not before.mode or after.home is not before.home:
            self.changed.set()
        if event is not None:
            self._tell(event)


_SAFE = frozenset(
    {
        SupervisorEvent.FOUND,
        SupervisorEvent.READIED,
        SupervisorEvent.LOST,
        SupervisorEvent.FAILED,
        SupervisorEvent.TROUBLE,
        SupervisorEvent.UNSAFE,
        SupervisorEvent.REJECT,
        SupervisorEvent.REVERT,
        SupervisorEvent.PAUSE,
        SupervisorEvent.STOP,
        SupervisorEvent.ENDED,
    }
)
"""Steps that are taken even if they cannot be written: none makes other gains than known ones live
or claims that any were accepted."""


def _nothing() -> None:
    pass
