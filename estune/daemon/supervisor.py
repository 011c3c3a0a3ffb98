"""Supervisor of one rig, in a thread of its own: does what the state machine's mode requires."""

import logging
import random
import threading
import time
from contextlib import suppress

from estune.core.control_chart import ChartSignal
from estune.core.gains import Gains
from estune.daemon import rig_access
from estune.daemon.check_trials import check_cut_off
from estune.daemon.config import RigTable
from estune.daemon.events import EventKind
from estune.daemon.faults import EventFacts, FaultCode
from estune.daemon.progress_watch import ProgressWatch
from estune.daemon.rig_access import HeldByOtherDaemon, RigAccess, TooManyVoidTrials
from estune.daemon.supervised_connection import (
    TRIAL_MODES,
    SharedResources,
    SupervisedConnection,
)
from estune.daemon.supervised_rig import Preempted, SupervisedRig
from estune.daemon.supervisor_state import GainSet, SupervisorEvent, SupervisorMode
from estune.daemon.tuning_runs import RunDecision
from estune.errors import (
    EstuneError,
    Interrupted,
    InvalidInput,
    JournalError,
    RigError,
    UnsafeStart,
)
from estune.run import archived_run, loop
from estune.run.disk_space import DiskForecast
from estune.run.loop import Progress
from estune.run.phase import Phase
from estune.run.session import Session
from estune.run.tuning_run import TuningRun

_POLL_S = 0.5
_JITTER = 0.5  # rigs that were lost together must not return together
_log = logging.getLogger(__name__)


class RigSupervisor:
    """Supervisor of one rig.

    Attributes:
        confirmed: Whether the rig has confirmed, at the end, that the nominal gains are live.
    """

    def __init__(self, settings: RigTable, rig: SupervisedRig, shared: SharedResources) -> None:
        self.name = settings.name
        self.confirmed = False
        self._settings = settings
        self._rig = rig
        self._shared = shared
        self._connection = SupervisedConnection(settings, rig, shared, self._wait)
        self._consecutive_failures = 0  # since a trial or a check of the live gains succeeded
        self._disk: DiskForecast | None = None
        self._stopping_since_s: float | None = None
        self._progress = ProgressWatch()
        name = f"supervisor {self.name}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        rig.abort_trial = self._connection.abort_trial

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Waits for the end of the thread; whether it has ended."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def is_stuck(self) -> bool:
        """Whether it has made no progress for longer than any step may take."""
        access = self._connection.access
        longest_s = access.description.limits.duration_max_s if access is not None else 0.0
        begun = self._thread.ident is not None
        return begun and self._thread.is_alive() and self._progress.is_stuck(longest_s)

    def _run(self) -> None:
        rig = self._rig
        try:
            goal = rig.state.goal
            rig.log_event(EventKind.STARTED, f"supervision of rig {self.name} begins: {goal}")
            while rig.mode is not SupervisorMode.STOPPED and not rig.refused:
                self._progress.mark()
                rig.changed.clear()
                with suppress(Preempted):
                    self._run_step()
        finally:
            self._disconnect()

    def _run_step(self) -> None:
        """Does what the mode requires; turns a failure into an event."""
        try:
            self._act(self._rig.mode)
        except Preempted:
            raise
        except HeldByOtherDaemon as error:
            self._leave_to(str(error))
        except (Interrupted, TooManyVoidTrials) as error:
            cut_off = isinstance(error, Interrupted)
            fault = FaultCode.TRIAL_CUT_OFF if cut_off else FaultCode.VOID_TRIALS
            self._pause_for_operator(str(error), fault)
        except UnsafeStart as error:
            self._rig.revert_to_original(str(error))
        except RigError as error:
            self._handle_rig_error(error)
        except InvalidInput as error:
            if self._connection.access is None:
                self._fail(str(error), FaultCode.SETTINGS)
            else:  # the file does not suit the rig: trying again does not help
                self._pause_for_operator(str(error), FaultCode.SETTINGS)
        except EstuneError as error:
            of_disk = isinstance(error, JournalError)
            self._fail(str(error), FaultCode.STORAGE if of_disk else FaultCode.DAEMON_ERROR)
        except Exception as error:  # noqa: BLE001  a fault here must not end the supervision
            _log.exception("rig %s", self.name, extra={"rig": self.name})
            self._fail(f"{type(error).__name__}: {error}", FaultCode.DAEMON_ERROR)

    def _act(self, mode: SupervisorMode) -> None:
        match mode:
            case SupervisorMode.WAITING | SupervisorMode.RETRYING:
                self._wait_for_rig()
            case SupervisorMode.READYING:
                self._apply_nominal_gains()
            case SupervisorMode.TUNING | SupervisorMode.CONFIRMING:
                self._tune()
            case SupervisorMode.WATCHING:
                self._watch()
            case SupervisorMode.HOLDING:
                self._monitor_gains(self._settings.look_every_s)
            case SupervisorMode.PAUSED:
                self._stay_paused()
            case SupervisorMode.STOPPING:
                self._restore_nominal_gains()

    def _leave_to(self, holder: str) -> None:
        """Leaves the rig to another daemon: until that one leaves it, or for good."""
        if self._shared.are_rigs_shared:
            self._rig.store.set_fact("fellow", holder)
            self._disconnect()
            sentence = f"held by {holder}; taken over when that daemon leaves it"
            self._rig.apply_event(SupervisorEvent.LOST, sentence)
        else:
            self._rig.refused = f"held by {holder}; stop one of the two daemons"
            sentence = f"rig {self.name} is not supervised: it is {self._rig.refused}"
            self._rig.log_event(EventKind.FAILED, sentence, fault=FaultCode.RIG_HELD)

    def _fail(self, why: str, fault: FaultCode) -> None:
        self._disconnect()
        self._consecutive_failures += 1
        self._rig.apply_event(SupervisorEvent.FAILED, why, fault=fault)

    def _handle_rig_error(self, error: RigError) -> None:
        """The rig is lost or held by others; after an emergency stop an operator is needed."""
        estop_reason = (
            self._connection.access.estop_reason() if self._connection.access is not None else ""
        )
        if estop_reason and self._rig.mode is not SupervisorMode.STOPPING:
            self._pause_for_operator(
                f"rig {self.name} is in its safe state after an emergency stop ({estop_reason}); "
                "check the rig, clear the stop, then resume",
                FaultCode.EMERGENCY_STOP,
            )
        else:
            self._disconnect()
            self._consecutive_failures += 1
            fault = FaultCode.RIG_LOST
            self._rig.apply_event(SupervisorEvent.LOST, str(error), fault=fault)

    def _pause_for_operator(self, why: str, fault: FaultCode) -> None:
        self._rig.apply_event(SupervisorEvent.TROUBLE, why, fault=fault)
        self._rig.mark_ready(None)

    def _wait_for_rig(self) -> None:
        """Connects to the rig, after a wait that doubles with each failure, if there is a place.

        The wait is random by half: rigs that were lost together do not return together.
        """
        if self._rig.state.failures:
            failures = max(self._rig.state.failures, self._consecutive_failures)
            wait_s = self._settings.retry_s(failures)
            if self._rest(wait_s * random.uniform(1.0 - _JITTER, 1.0)):  # noqa: S311  no secret
                return
        full = self._shared.admission.take_place(self.name)
        if self._rig.waits_for != full:
            self._rig.waits_for = full
        if full:
            self._rest(self._settings.look_every_s)
            return
        access = self._connection.open()
        if self._shared.are_rigs_shared:
            others = [other for other in access.daemons() if other != self._shared.instance]
            if holder := access.other_daemon() or (others and f"daemon {others[0]}"):
                raise HeldByOtherDaemon(holder)
        sentence = f"rig {self.name} answers"
        self._rig.apply_event(SupervisorEvent.FOUND, sentence)

    def _apply_nominal_gains(self) -> None:
        access, home = self._connection.access or self._connection.open(), self._rig.state.home
        with self._shared.admission.connecting(self._settings.answer_within_s):
            shared = self._shared.are_rigs_shared
            obstacle = rig_access.apply_nominal_gains(self._rig, access, home, shared=shared)
        if self._shared.fleet is not None:
            self._shared.fleet.announce(self.name)
        home = self._rig.state.home  # also where another daemon left other gains
        if obstacle is not None:
            access.release()
            self._pause_for_operator(*obstacle)
            return
        if self._rig.state.paused:
            access.release()
        self._rig.mark_ready(home)

    def _tune(self) -> None:
        """Continues the tuning run from the end of its journal, and applies its result."""
        access = self._connection.required()
        with self._shared.admission.computing:
            decision = self._complete(self._rig.tuning_runs.open(access.description), access)
        self._rig.apply_decision(decision, accept=self._settings.accept == "auto")

    def _complete(self, run: TuningRun, access: RigAccess) -> RunDecision:
        self._rig.session = run.session
        self._disk = DiskForecast(run.journal) if run.journal is not None else None
        try:
            done = f"{run.session.number} trials done, " if run.session.number else ""
            sentence = f"tuning {run.plan.run}: {done}at most {run.plan.max_trials} trials"
            self._rig.log_event(EventKind.TUNING, sentence)
            self._follow_phase(run)
            with self._connection.trials():
                loop.run(run, access, [self._on_trial])
            self._follow_phase(run)
            decision = self._rig.tuning_runs.decide(run)
            if run.journal is not None:
                run.journal.note(**archived_run.finished(run))
            return decision
        finally:
            if run.journal is not None:
                run.journal.close()

    def _follow_phase(self, run: TuningRun) -> None:
        """Synchronises the mode with the phase of a resumed run, which may be past its search."""
        if not run.session.is_open and self._rig.mode is SupervisorMode.TUNING:
            self._announce_confirmation(run.session)

    def _announce_confirmation(self, session: Session) -> None:
        sentence = f"confirming {session.plan.run}; {session.search_end}"
        self._rig.apply_event(SupervisorEvent.SEARCHED, sentence)

    def _on_trial(self, progress: Progress) -> None:
        """After each trial, which is committed by now."""
        self._progress.mark()
        self._consecutive_failures = 0
        mode = self._rig.mode
        self._rig.session = progress.session
        self._warn_of_the_disk(progress.session.trials_left)
        self._rig.note_cost(progress.entry.cost)
        is_past_search = progress.session.phase in (Phase.CHOOSE, Phase.CONFIRM)
        if is_past_search and mode is SupervisorMode.TUNING:
            self._announce_confirmation(progress.session)
        if self._rig.mode not in (SupervisorMode.TUNING, SupervisorMode.CONFIRMING):
            raise Preempted
        # Before the run says it, which would name `estune resume`: the verb is the daemon's here.
        check_cut_off(progress.record, self._connection.required().description)

    def _warn_of_the_disk(self, trials_left: int) -> None:
        """Logs once in a run that its disk will be full within a day."""
        if self._disk is not None and (warning := self._disk.warning(trials_left)):
            self._disk = None
            self._rig.log_event(EventKind.DISK, warning, fault=FaultCode.DISK_LOW)

    def _watch(self) -> None:
        rig, access, home = self._rig, self._connection.required(), self._rig.state.home
        if rig.checks.chart(home) is None:
            reason = "there is no baseline for the check trials"
            rig.apply_event(SupervisorEvent.DRIFTED, reason)
            return
        wait_s, gains = rig.checks.wait_s(home), rig.store.gains()[home]
        check_s = min(wait_s, rig.margins.wait_s)
        if (next_s := min(check_s, rig.behaviour.wait_s)) > 0.0:
            self._monitor_gains(min(next_s, self._settings.look_every_s))
            return
        if not check_s:
            self._check(access, home, gains, with_step=not wait_s)
        if rig.mode is SupervisorMode.WATCHING and not rig.behaviour.wait_s:
            self._check_behaviour(access)

    def _check(self, access: RigAccess, home: GainSet, gains: Gains, *, with_step: bool) -> None:
        rig = self._rig
        with self._shared.admission.computing, self._connection.trials():
            about = access.description
            check = rig.checks.run(access, about, home, gains) if with_step else None
            rig.handle_margins(rig.margins.take(check and check.record, access, about, gains))
        self._consecutive_failures = 0
        if check is None:
            return
        rig.note_cost(check.cost)
        if check.signal is None:
            return
        sentence = f"check trial {check.record.trial_id}: {check.signal.sentence}"
        _log.debug("%s", sentence, extra={"rig": self.name})
        if check.signal in (ChartSignal.SUSPECT, ChartSignal.OUTLIER):
            rig.log_event(EventKind(check.signal), sentence, cost=rig.cost)
        if check.signal in (ChartSignal.WORSE, ChartSignal.BETTER):
            rig.handle_drift(check.cost, check.signal)

    def _check_behaviour(self, access: RigAccess) -> None:
        with self._shared.admission.computing, self._connection.trials():
            for effect, why in self._rig.behaviour.take(access, access.describe()):
                sentence = f"the remedy against {effect} is switched off: {why}"
                fault = FaultCode.REMEDY_LOST
                self._rig.log_event(EventKind.REMEDY, sentence, fault=fault)
        self._consecutive_failures = 0

    def _monitor_gains(self, seconds: float) -> None:
        """Waits, then compares the rig's live gains with the nominal ones."""
        if self._rest(seconds):
            return
        home = self._rig.state.home
        live = self._connection.required().describe().gains
        self._consecutive_failures = 0
        if live != self._rig.store.gains()[home]:
            reason = f"the rig runs {live} instead of the {home} gains"
            self._rig.apply_event(SupervisorEvent.CHANGED, reason)

    def _stay_paused(self) -> None:
        access = self._connection.required()
        access.release()
        if not self._rest(self._settings.look_every_s):
            # Others may set gains meanwhile: the status must not go on to claim the nominal ones.
            self._rig.note_live(access.describe().gains)

    def _restore_nominal_gains(self) -> None:
        if self._stopping_since_s is None:
            self._stopping_since_s = time.monotonic()
        rig, name = self._rig, self._rig.state.home
        home, fault = rig.store.gains().get(name), ""
        if home is not None:
            try:
                access = self._connection.access or self._connection.open()
                shared = self._shared.are_rigs_shared
                fault = rig_access.restore_nominal_gains(rig, access, home, shared=shared)
            except EstuneError as error:
                self._disconnect()
                if time.monotonic() - self._stopping_since_s < self._shared.stop_within_s:
                    self._rest(_POLL_S)
                    return
                fault = (
                    f"the {name} gains could not be confirmed on the rig ({error}); they are "
                    "restored when the daemon is started again"
                )
        self.confirmed = not fault
        ended = f"ended; the rig has confirmed its gains: {home}" if home else "ended"
        facts: EventFacts = {"fault": FaultCode.NOT_RESTORED} if fault else {}
        rig.apply_event(SupervisorEvent.ENDED, fault, sentence=fault or ended, **facts)

    def _disconnect(self) -> None:
        if not self.confirmed:  # gains that were confirmed at the end are no longer changed
            self._rig.live = None
        self._connection.close()

    def _wait(self, reason: str) -> None:
        """While a trial waits for its turn."""
        self._progress.mark()
        self._rig.waits_for = reason
        if reason and self._rig.mode not in TRIAL_MODES:
            self._rig.waits_for = ""
            raise Preempted

    def _rest(self, seconds: float) -> bool:
        """Waits; whether the state changed before the time was over."""
        self._progress.mark(seconds)
        changed = self._rig.changed.wait(seconds)
        self._progress.mark()
        return changed
