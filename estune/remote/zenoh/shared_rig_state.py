"""What an attendant has in hand: the state of the link, and the trial under way, behind one lock.

Two threads see to it that both end: one has a trial stopped that is to stop, the other is the
dead-man's switch. The lock is never held while anything is written or anything moves.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue

from estune.errors import EstuneError
from estune.remote.state_machine import events
from estune.remote.state_machine import rig as machine
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import RigAction, RigState, Transition
from estune.remote.zenoh.replies import to_estune_error
from estune.trial import Rig, TrialRequest

_ABORT_AGAIN_S = 0.05

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class ActiveTrial:
    """The trial in hand.

    Attributes:
        request: What is asked.
        digest: Of the request.
        told_to_stop: Whether it is to stop.
        stop_failed: What the rig raised when it was told to, until somebody has been told.
    """

    request: TrialRequest
    digest: str
    told_to_stop: bool = False
    stop_failed: EstuneError | None = None


class SharedRigState:
    """The state, the trial in hand, and the threads that end them.

    Attributes:
        lock: Guards the two below.
        state: Where the link stands.
        trial: The trial in hand, or None.
    """

    def __init__(self, rig: Rig, latched: str, changed: Callable[[], None]) -> None:
        """Begins, with no trial in hand.

        Args:
            rig: The rig, of which only `abort` is called.
            latched: Why there is an emergency stop; empty if there is none.
            changed: Called when the status has changed.
        """
        self.lock = threading.Lock()
        self.state = RigState(latched=latched)
        self.trial: ActiveTrial | None = None
        self._rig = rig
        self._changed = changed
        self._ended = threading.Condition(self.lock)
        self._leased = threading.Condition(self.lock)
        self._stopping: SimpleQueue[ActiveTrial | None] = SimpleQueue()
        # Ready from the start: no thread can be made while the interpreter shuts down. Daemons: a
        # rig that will not stop must not keep the process from ending.
        for name, work in (("aborts", self._stop_trials), ("lease", self._watch_lease)):
            threading.Thread(target=work, name=name, daemon=True).start()

    def step(self, event: events.Event, now_s: float) -> Transition:
        """Moves the state on, and has a trial stopped where that is ordered. The lock is held."""
        before = self.state
        move = machine.step(before, event, now_s)
        self.state = move.state
        trial = self.trial
        if RigAction.STOP in move.orders and trial is not None and not trial.told_to_stop:
            trial.told_to_stop = True
            self._stopping.put(trial)
        if isinstance(event, events.Acquire | events.Close):
            self._leased.notify_all()
        if move.state is not before and not isinstance(event, events.Renew):
            self._changed()
        return move

    def apply_event(self, event: events.Event) -> Transition:
        """Moves the state on from now, as `step`."""
        with self.lock:
            return self.step(event, time.monotonic())

    def may_begin(self) -> bool:
        """Whether the trial in hand may move the rig."""
        return self.apply_event(events.Begin()).verdict is ReplyCode.ACCEPTED

    def finish_trial(self) -> None:
        """The trial in hand has ended, and the live gains are back."""
        with self.lock:
            self.step(events.End(), time.monotonic())
            self.trial = None
            self._ended.notify_all()

    def why_stopped(self) -> str:
        """Why the trial in hand is to stop; empty if it is not."""
        with self.lock:
            return "" if self.state.trial is None else self.state.trial.stopping

    def close(self, within_s: float) -> bool:
        """Ends what is in hand; whether it has ended in time."""
        self.apply_event(events.Close())
        self._stopping.put(None)
        with self.lock:
            return self._ended.wait_for(lambda: self.trial is None, within_s)

    def _stop_trials(self) -> None:
        while (trial := self._stopping.get()) is not None:
            ended = False
            while not ended:  # again and again: the first call may come before the trial begins
                try:
                    self._rig.abort()
                except BaseException as error:  # noqa: BLE001  even SystemExit: the stop must hold
                    if trial.stop_failed is None:
                        trial.stop_failed = to_estune_error(error, "stopping the trial")
                with self.lock:
                    ended = self._ended.wait_for(partial(self._has_ended, trial), _ABORT_AGAIN_S)

    def _has_ended(self, trial: ActiveTrial) -> bool:
        return self.trial is not trial

    def _watch_lease(self) -> None:
        """The dead-man's switch: ends a lease that is not renewed."""
        with self.lock:
            while not self.state.closed:
                lease, now_s = self.state.lease, time.monotonic()
                if lease is None:
                    self._leased.wait()
                elif now_s < lease.expires_at_s:
                    self._leased.wait(lease.expires_at_s - now_s)
                else:
                    _log.warning("the lease of %s ran out", lease.holder)
                    self.step(events.Expire(), now_s)
