"""Access of a supervisor to its rig: connection, checked trials, and the nominal gains.

The gains a rig is found with are stored before any others are applied. Gains that were not set
through this daemon are foreign: they are left as they are until an operator decides.
"""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from datetime import UTC, datetime

from estune.core.gains import Gains
from estune.daemon.config import RigTable
from estune.daemon.events import EventKind
from estune.daemon.faults import FaultCode
from estune.daemon.supervised_rig import RigCounts, SupervisedRig
from estune.daemon.supervisor_state import GainSet
from estune.errors import EstuneError, PlantError, RigError
from estune.remote import zenoh
from estune.remote.zenoh import RemoteRig
from estune.remote.zenoh.network import Network
from estune.run.failed_trials import FailureMemory, run_trial
from estune.run.submitted_trial import TrialNotes
from estune.run.targets import is_endpoint, open_target
from estune.trial import (
    CompensatedRig,
    Outcome,
    Rig,
    RigDescription,
    TrialRecord,
    TrialRequest,
    empty_record,
)
from estune.trial.record_checks import record_fault

VOID_TRIALS_MAX = 5
"""Consecutive void trials after which an operator is needed."""

HOLDER_PREFIX = "estune daemon"
"""Beginning of a daemon's name as the holder of a rig's lease."""

_ABORT_PERIOD_S = 0.05  # a trial that is just beginning may miss the first abort
_log = logging.getLogger(__name__)


class HeldByOtherDaemon(RigError):
    """Another daemon, named by the message, supervises the rig."""


class TooManyVoidTrials(Exception):
    """An operator is needed: the rig answers, but its trials are void one after the other.

    Like `Preempted` it ends what is under way and is no failure of the trial, which has its void
    record: `run_trial` makes a trial void by `EstuneError` alone.
    """


class VoidTrialCounter:
    """Counts consecutive void trials, also across reconnections: a rig may restart in each."""

    def __init__(self) -> None:
        self._consecutive = 0

    def count(self, record: TrialRecord) -> None:
        """Counts a trial.

        Raises:
            TooManyVoidTrials: the limit is reached.
        """
        self._consecutive = self._consecutive + 1 if record.outcome.is_void else 0
        if self._consecutive >= VOID_TRIALS_MAX:
            self._consecutive = 0
            raise TooManyVoidTrials(
                f"{VOID_TRIALS_MAX} consecutive trials were void, the last {record.trial_id}: "
                f"{record.reason}; fix the cause, then resume"
            )


class RigAccess:
    """A connected rig whose records are checked; implements `estune.trial.Rig`."""

    def __init__(
        self,
        rig: Rig,
        holder: str,
        opened: ExitStack,
        void_trials: VoidTrialCounter,
        *,
        turn: Callable[[], AbstractContextManager[None]],
        counts: RigCounts,
        notes: TrialNotes | None,
    ) -> None:
        """Use `open_rig`."""
        self._rig = rig
        self._holder = holder
        self._void_trials = void_trials
        self._turn = turn
        self._counts = counts
        self._notes = notes
        self.description = rig.describe()
        self.abort, self.estop, self.clear = rig.abort, rig.estop, rig.clear
        self.close = opened.close

    def describe(self) -> RigDescription:
        """Description of the rig, with its live gains."""
        self.description = self._rig.describe()
        return self.description

    def acquire(self) -> RigDescription:
        """Takes the right to command the rig, and ends a trial that an earlier process left.

        Raises:
            HeldByOtherDaemon: another daemon has the right.
            RigError: another client has it, or the rig cannot be reached.
        """
        if isinstance(self._rig, RemoteRig):
            try:
                self._rig.acquire()
            except RigError as error:
                # A lease of this process, lost in an overload, expires by itself.
                if other := self.other_daemon():
                    raise HeldByOtherDaemon(other) from error
                raise
        self.description = self._rig.abort()
        return self.description

    def other_daemon(self) -> str:
        """The other daemon that holds the rig, in words; empty if none does."""
        if not isinstance(self._rig, RemoteRig):
            return ""
        holder = self._rig.status().holder
        return holder if holder.startswith(HOLDER_PREFIX) and holder != self._holder else ""

    def daemons(self) -> list[str]:
        """Instances of the daemons that have the rig, as far as they join its network."""
        return self._rig.daemons() if isinstance(self._rig, RemoteRig) else []

    @property
    def original(self) -> Gains | None:
        """The rig's original gains, where daemons that share it have set the live ones."""
        return self._rig.original if isinstance(self._rig, RemoteRig) else None

    def apply(self, gains: Gains, original: Gains | None = None) -> None:
        """Makes gains the live ones, and reads them back.

        Args:
            original: The original gains, for another daemon that takes the rig over.

        Raises:
            RigError: the rig refuses them, or reports others.
        """
        if isinstance(self._rig, RemoteRig):
            self._rig.apply(gains, original)
        else:
            self._rig.apply(gains)
        # A rig that clamps them would be watched by the baseline of gains that it does not run.
        live = self.describe().gains
        if live != gains:
            raise RigError(
                f"rig {self.description.name} was given {gains} and reports other live gains: "
                f"{live}"
            )

    def switch_off(self, tables: Sequence[str]) -> None:
        """Switches compensations off."""
        if not isinstance(self._rig, CompensatedRig):
            raise RigError(f"rig {self.description.name} cannot switch compensations off")
        self._rig.switch_off(tables)
        self.describe()

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs a trial. A record with a fault, or a failure of the rig's program, makes it void.

        Raises:
            RigError: the rig cannot be reached.
            TooManyVoidTrials: too many consecutive trials were void.
        """
        before = self._leases_lost()
        try:
            with self._turn():
                begun_s = time.monotonic()
                record = run_trial(self._rig, request, self.description, notes=self._notes)
                self._counts.note_trial(record.outcome, time.monotonic() - begun_s)
        except PlantError as error:
            if isinstance(self._rig, RemoteRig):
                raise
            record = self._void(request, str(error))
        fault = record_fault(record, request, self.description)
        if fault:
            reason = f"the record of trial {request.trial_id} is refused: {fault}"
            record = self._void(request, reason)
        lost = self._leases_lost() - before
        self._counts.leases_lost += lost
        if not (record.outcome is Outcome.CANCELLED and lost):
            self._void_trials.count(record)  # an overload, which ends by itself, needs no operator
        return record

    def has_failed(self, request: TrialRequest) -> bool:
        """Whether no record can ever be had under a trial's id."""
        return isinstance(self._rig, FailureMemory) and self._rig.has_failed(request)

    def estop_reason(self) -> str:
        """Reason of the rig's emergency stop; empty if there is none or it is not known."""
        if isinstance(self._rig, RemoteRig):
            with suppress(EstuneError):
                return self._rig.status().latched
        return ""

    def abort_trials(self, while_: Callable[[], bool]) -> None:
        """Ends the trial under way, and any that is just beginning, while the condition holds."""
        with suppress(EstuneError):
            while while_():
                self._rig.abort()
                time.sleep(_ABORT_PERIOD_S)

    def release(self) -> None:
        """Returns the right to command."""
        if isinstance(self._rig, RemoteRig):
            self._rig.release()

    def _leases_lost(self) -> int:
        return self._rig.leases_lost if isinstance(self._rig, RemoteRig) else 0

    def _void(self, request: TrialRequest, reason: str) -> TrialRecord:
        _log.error("%s", reason, extra={"rig": self.description.name})
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        return empty_record(request, self.description, Outcome.CANCELLED, reason, at)


def open_rig(
    settings: RigTable,
    holder: str,
    void_trials: VoidTrialCounter,
    network: Network,
    *,
    turn: Callable[[], AbstractContextManager[None]] = nullcontext,
    counts: RigCounts | None = None,
    notes: TrialNotes | None = None,
) -> RigAccess:
    """Connects to a rig.

    Raises:
        RigError: the rig does not answer.
        InvalidInput: the target is not one.
    """
    with ExitStack() as opened:
        if is_endpoint(settings.target):
            remote = zenoh.connect(
                *(settings.target, settings.name, settings.answer_within_s),
                holder=holder,
                network=network,
            )
            opened.callback(remote.close)
            rig: Rig = remote
        else:
            rig = opened.enter_context(open_target(settings.target, settings.name))
        kept = rig, holder, opened.pop_all(), void_trials
        return RigAccess(*kept, turn=turn, counts=counts or RigCounts(), notes=notes)


def apply_nominal_gains(
    rig: SupervisedRig, access: RigAccess, home: GainSet, *, shared: bool
) -> tuple[str, FaultCode] | None:
    """Makes the nominal gains live; stores the rig's original gains the first time.

    Args:
        home: Name of the nominal gains.
        shared: Whether other daemons may take the rig over: it then keeps its original gains, and
            gains that one of them has left are taken over as accepted ones.

    Returns:
        Why not, and the fault, where an operator is needed.
    """
    description, store = access.acquire(), rig.store
    # The gains of one reel may make another unstable.
    if mismatch := _identity_mismatch(rig, description):
        return mismatch, FaultCode.OTHER_RIG
    left = access.original if shared else None
    if not store.gains():  # before any others are applied, or the way back is lost
        _back_up(rig, description, left)
    if description.gains not in store.all_gain_sets() and not store.fact("overrule"):
        fellow = store.fact("fellow") or (left and "another daemon")
        if not fellow:
            return _foreign_gains(description), FaultCode.FOREIGN_GAINS
        rig.inherit(description.gains, f"{fellow} had the rig before, and left it these")
        home = rig.state.home
    with store.transaction():
        for fact in ("overrule", "fellow"):
            store.set_fact(fact, None)
    gains = store.gains()[home]
    if description.gains != gains:
        access.apply(gains, store.gains()[GainSet.ORIGINAL] if shared else None)
        sentence = f"{home} gains are live: {rig.state.why}"
        rig.log_event(EventKind.GAINS, sentence, gains=str(gains))
    if off := rig.behaviour.enforce(access, access.description):
        sentence = f"the rig had {off} on again, whose gain was lost; switched off"
        rig.log_event(EventKind.REMEDY, sentence)
    return None


def restore_nominal_gains(
    rig: SupervisedRig, access: RigAccess, home: Gains, *, shared: bool
) -> str:
    """Makes the nominal gains live again; why they are not, if they are not."""
    description, state = access.acquire(), rig.state
    if description.gains not in rig.store.all_gain_sets():
        return _foreign_gains(description)
    if description.gains != home:
        access.apply(home, rig.store.gains()[GainSet.ORIGINAL] if shared else None)
        rig.log_event(EventKind.GAINS, f"{state.home} gains are live: {state.why}")
    rig.live = state.home
    return ""


def _identity_mismatch(rig: SupervisedRig, description: RigDescription) -> str:
    stored = rig.store.fact("rig_facts")
    if stored is None or stored == _identity(description):
        return ""
    return (
        f"the rig reports name {description.name!r} and {description.newtons_per_ampere:g} N/A, "
        f"the one stored in {rig.store.folder} has name {stored['name']!r} and "
        f"{stored['newtons_per_ampere']:g} N/A; "
        "connect that one, then resume; or give this one a name and a folder of its own"
    )


def _back_up(rig: SupervisedRig, description: RigDescription, left: Gains | None) -> None:
    """Stores the gains the rig runs, or those it has kept for whoever takes it over."""
    gains, why = description.gains, "the rig ran them when it was found"
    if left is not None:
        gains, why = left, "the rig ran them before another daemon set others"
    with rig.store.transaction():
        rig.store.set_fact("rig_facts", _identity(description))
        rig.store.set_gains(GainSet.ORIGINAL, gains, why)
    sentence = f"the rig's original gains are stored: {gains}"
    rig.log_event(EventKind.BACKED_UP, sentence, gains=str(gains))


def _identity(description: RigDescription) -> dict[str, str | float]:
    return {"name": description.name, "newtons_per_ampere": description.newtons_per_ampere}


def _foreign_gains(description: RigDescription) -> str:
    return (
        f"rig {description.name} runs {description.gains}, which were not set through this "
        "daemon; they are left as they are: resume applies the nominal gains, revert the "
        "original ones"
    )
