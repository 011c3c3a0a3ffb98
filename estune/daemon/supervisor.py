"""Carries out, for one rig and in a thread of its own, what the table in `life` says."""

import logging
import math
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from estune.core.control_chart import ChartSignal
from estune.daemon import gain_restoration
from estune.daemon.config import RigTable
from estune.daemon.decisions import apply_tuning_decision, handle_drift, revert_to_original
from estune.daemon.events import EventKind
from estune.daemon.rig_access import (
    HOLDER,
    Refused,
    RigAccess,
    TooManyVoidTrials,
    VoidTrialCounter,
    open_rig,
)
from estune.daemon.supervised_rig import Preempted, SupervisedRig
from estune.daemon.supervisor_state import SupervisorEvent, SupervisorMode
from estune.errors import EstuneError, Interrupted, InvalidInput, RigError, UnsafeStart
from estune.remote.security import OPEN, Security
from estune.run import archived_run, loop
from estune.run.loop import Progress, TuningRun
from estune.run.session import Phase

PATIENCE_S = 120.0
"""A keeper that has made no step for so long, beside the longest trial, is stuck."""

_STEP_S = 0.5
_log = logging.getLogger(__name__)


class RigSupervisor:
    """Does with one rig what its supervision says. `start` begins it.

    Attributes:
        name: The rig.
        confirmed: Whether the rig has confirmed, at the end, that the home gains are live.
    """

    def __init__(
        self,
        settings: RigTable,
        supervision: SupervisedRig,
        *,
        stop_within_s: float,
        security: Security = OPEN,
    ) -> None:
        self.name = settings.name
        self.confirmed = False
        self._settings = settings
        self._supervision = supervision
        self._stop_within_s = stop_within_s
        self._security = security
        self._reached: RigAccess | None = None
        self._patience = VoidTrialCounter()
        self._fruitless = 0  # failures since a trial was told or the rig was looked at in peace
        self._cuttable = False
        self._stopping_since_s: float | None = None
        self._step_at_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=f"keeper {self.name}", daemon=True)
        supervision.cut = self._cut

    def start(self) -> None:
        """Begins."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Waits for the end; whether it has come."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def is_stuck(self) -> bool:
        """Whether it has made no step for longer than anything may take."""
        reached = self._reached
        longest_s = reached.about.limits.duration_max_s if reached is not None else 0.0
        allowed_s = PATIENCE_S + 2.0 * min(longest_s, PATIENCE_S)  # some rigs have no limit
        begun = self._thread.ident is not None
        alive = begun and self._thread.is_alive()
        return alive and time.monotonic() - self._step_at_s > allowed_s

    def _run(self) -> None:
        try:
            self._supervision.note(
                EventKind.STARTED,
                f"supervision of rig {self.name} begins: {self._supervision.life.goal}",
            )
            while (
                self._supervision.mode is not SupervisorMode.STOPPED
                and not self._supervision.refused
            ):
                self._mark_progress()
                self._supervision.changed.clear()
                with suppress(Preempted):
                    self._run_step()
        finally:
            live = self._supervision.live
            self._disconnect()
            if self.confirmed:
                self._supervision.live = live  # as last heard, and nobody changes it now

    def _run_step(self) -> None:
        """Does what is to be done now, and says what came of it if that failed."""
        try:
            self._act(self._supervision.mode)
        except Preempted:
            raise
        except Refused as error:
            self._supervision.refused = str(error)
            self._supervision.note(
                EventKind.FAILED, f"rig {self.name} is left alone: it is {error}"
            )
        except (Interrupted, TooManyVoidTrials) as error:
            self._pause_for_operator(str(error))
        except UnsafeStart as error:
            revert_to_original(self._supervision, str(error))
        except RigError as error:
            self._without_rig(error)
        except InvalidInput as error:
            if self._reached is None:
                self._fail(str(error))
            else:  # the file does not suit the rig, however often it is tried
                self._pause_for_operator(str(error))
        except EstuneError as error:
            self._fail(str(error))
        except Exception as error:  # noqa: BLE001  a fault here must not end the keeping
            _log.exception("rig %s", self.name, extra={"rig": self.name})
            self._fail(f"{type(error).__name__}: {error}")

    def _fail(self, why: str) -> None:
        """Begins anew with the rig, after a while."""
        self._disconnect()
        self._fruitless += 1
        self._supervision.apply_event(SupervisorEvent.FAILED, why, EventKind.FAILED)

    def _act(self, mode: SupervisorMode) -> None:
        match mode:
            case SupervisorMode.WAITING | SupervisorMode.RETRYING:
                self._await()
            case SupervisorMode.READYING:
                self._ready()
            case SupervisorMode.TUNING | SupervisorMode.CONFIRMING:
                self._search()
            case SupervisorMode.WATCHING:
                self._watch()
            case SupervisorMode.HOLDING:
                self._monitor_gains(None)
            case SupervisorMode.PAUSED:
                self._pause()
            case SupervisorMode.STOPPING:
                self._restore()

    def _without_rig(self, error: RigError) -> None:
        """The rig is gone, or in others' hands. After an emergency stop nothing moves unasked."""
        latched = self._reached.latched() if self._reached is not None else ""
        if latched and self._supervision.mode is not SupervisorMode.STOPPING:
            self._pause_for_operator(
                f"rig {self.name} is in its safe state after an emergency stop ({latched}); "
                "see to it, clear the stop, then resume"
            )
        else:
            self._disconnect()
            self._fruitless += 1
            self._supervision.apply_event(SupervisorEvent.LOST, str(error), EventKind.LOST)

    def _pause_for_operator(self, why: str) -> None:
        """Pauses until somebody has seen to the rig."""
        self._supervision.apply_event(SupervisorEvent.TROUBLE, why, EventKind.TROUBLE)
        self._supervision.readied(None)

    def _await(self) -> None:
        """Waits longer after each failure, then looks for the rig."""
        if self._supervision.life.failures:
            failures = max(self._supervision.life.failures, self._fruitless)
            first_s, most_s = self._settings.retry_first_s, self._settings.retry_max_s
            # The exponent is bounded: a rig may be away for years.
            if self._rest(min(most_s, first_s * 2.0 ** min(failures - 1, 30))):
                return
        self._connect()
        self._supervision.apply_event(
            SupervisorEvent.FOUND, f"rig {self.name} answers", EventKind.FOUND
        )

    def _connect(self) -> RigAccess:
        self._disconnect()
        self._reached = open_rig(
            self._settings,
            f"{HOLDER} on {socket.gethostname()}, process {os.getpid()}",
            self._patience,
            self._security,
        )
        return self._reached

    def _ready(self) -> None:
        """Sees to it that the home gains are live, if the rig is the one that is known."""
        reached, home = self._reached or self._connect(), self._supervision.life.home
        fault = gain_restoration.apply_nominal_gains(self._supervision, reached, home)
        if fault:
            reached.release()
            self._pause_for_operator(fault)
            return
        if self._supervision.life.paused:
            reached.release()
        self._supervision.readied(home)

    def _search(self) -> None:
        """Tunes, from where the run's journal ends, and decides."""
        reached = self._there()
        run = self._supervision.searches.open(reached.about)
        self._supervision.session = run.session
        try:
            self._supervision.note(
                EventKind.TUNING,
                f"run {run.plan.run}: trials {run.session.number} to {run.plan.most_trials}",
            )
            self._show(run)
            with self._in_trials():
                loop.run(run, reached.as_rig, [self._progressed])
            self._show(run)
            decision = self._supervision.searches.decide(run)
            if run.journal is not None:
                run.journal.note(**archived_run.finished(run))
        finally:
            if run.journal is not None:
                run.journal.close()
        apply_tuning_decision(self._supervision, decision, accept=self._settings.accept == "auto")

    def _show(self, run: TuningRun) -> None:
        """Makes the phase of the run that of the life: a run may be found past its search."""
        past = run.session.phase not in (Phase.BASELINE, Phase.SEARCH)
        if past and self._supervision.mode is SupervisorMode.TUNING:
            self._supervision.apply_event(
                SupervisorEvent.SEARCHED, f"confirming {run.plan.run}", EventKind.CONFIRMING
            )

    def _progressed(self, progress: Progress) -> None:
        """After each trial, which is committed by now."""
        self._mark_progress()
        self._fruitless = 0
        entered = self._supervision.mode
        self._supervision.session = progress.session
        self._supervision.cost = _finite(progress.entry.cost)
        after = progress.session.phase in (Phase.CHOOSE, Phase.CONFIRM)
        if after and entered is SupervisorMode.TUNING:
            said = f"confirming {progress.session.plan.run}; {progress.session.search_end}"
            self._supervision.apply_event(SupervisorEvent.SEARCHED, said, EventKind.CONFIRMING)
        if self._supervision.mode not in (SupervisorMode.TUNING, SupervisorMode.CONFIRMING):
            raise Preempted

    def _watch(self) -> None:
        """Waits for the next check trial, runs it, and looks at the chart."""
        reached, home = self._there(), self._supervision.life.home
        if self._supervision.checks.chart(home) is None:
            self._supervision.apply_event(
                SupervisorEvent.DRIFTED,
                "there is no baseline to hold checks to",
                EventKind.DRIFTED,
            )
            return
        wait_s = self._supervision.checks.wait_s(home)
        if wait_s > 0.0:
            self._monitor_gains(wait_s)
            return
        gains = self._supervision.store.gains()[home]
        with self._in_trials():
            checked = self._supervision.checks.run(reached.as_rig, reached.about, home, gains)
        self._fruitless = 0
        self._supervision.cost = _finite(checked.cost)
        if checked.sign is None:
            return
        said = f"check trial {checked.record.trial_id}: {checked.sign.sentence}"
        _log.debug("%s", said, extra={"rig": self.name})
        if checked.sign in (ChartSignal.SUSPECT, ChartSignal.OUTLIER):
            self._supervision.note(EventKind(checked.sign), said, cost=_finite(checked.cost))
        if checked.sign in (ChartSignal.WORSE, ChartSignal.BETTER):
            handle_drift(self._supervision, checked.cost, checked.sign)

    def _monitor_gains(self, seconds: float | None) -> None:
        """Nothing is done with the rig for a while, but that its gains are looked at."""
        look_s = self._settings.look_every_s
        if self._rest(look_s if seconds is None else min(seconds, look_s)):
            return
        home = self._supervision.life.home
        about = self._there().describe()
        self._fruitless = 0
        if about.gains != self._supervision.store.gains()[home]:
            said = f"the rig runs {about.gains} instead of the {home} gains"
            self._supervision.apply_event(SupervisorEvent.CHANGED, said, EventKind.GAINS)

    def _pause(self) -> None:
        """The rig is others' to use; it is only seen whether it is there."""
        reached = self._there()
        reached.release()
        if not self._rest(self._settings.look_every_s):
            reached.describe()

    def _restore(self) -> None:
        """Puts the home gains back, so long as there is hope of it."""
        if self._stopping_since_s is None:
            self._stopping_since_s = time.monotonic()
        home = self._supervision.store.gains().get(self._supervision.life.home)
        said = ""
        if home is not None:
            try:
                said = gain_restoration.restore_nominal_gains(
                    self._supervision, self._reached or self._connect(), home
                )
            except EstuneError as error:
                self._disconnect()
                if time.monotonic() - self._stopping_since_s < self._stop_within_s:
                    self._rest(_STEP_S)
                    return
                said = (
                    f"the {self._supervision.life.home} gains could not be confirmed on the rig "
                    f"({error}); they are put back when the daemon is started again"
                )
        self.confirmed = not said
        ended = said or f"ended; the rig has confirmed its gains: {home}" if home else "ended"
        self._supervision.apply_event(
            SupervisorEvent.ENDED, said, EventKind.STOPPED, sentence=ended
        )

    def _there(self) -> RigAccess:
        if self._reached is None:
            raise RigError(f"rig {self.name} is not connected")
        return self._reached

    def _disconnect(self) -> None:
        reached, self._reached, self._supervision.live = self._reached, None, None
        if reached is not None:
            with suppress(EstuneError):
                reached.close()

    @contextmanager
    def _in_trials(self) -> Iterator[None]:
        """Trials are run in the block, which a stop cuts off."""
        self._cuttable = True
        try:
            if self._supervision.mode not in (
                SupervisorMode.TUNING,
                SupervisorMode.CONFIRMING,
                SupervisorMode.WATCHING,
            ):
                raise Preempted
            yield
        finally:
            self._cuttable = False

    def _cut(self) -> None:
        """Ends the trial under way, if any, without making anybody wait."""
        reached = self._reached
        if self._cuttable and reached is not None:
            threading.Thread(
                target=reached.cut, args=(lambda: self._cuttable,), daemon=True
            ).start()

    def _rest(self, seconds: float) -> bool:
        """Waits; whether something happened before the time was over."""
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0.0:
            self._mark_progress()
            if self._supervision.changed.wait(min(left_s, _STEP_S)):
                return True
        return False

    def _mark_progress(self) -> None:
        self._step_at_s = time.monotonic()


def _finite(cost: float) -> float | None:
    return cost if math.isfinite(cost) else None
