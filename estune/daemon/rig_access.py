"""A rig as a keeper uses it: taken before it is used, its records looked at before they count."""

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import UTC, datetime

from estune.core.gains import Gains
from estune.daemon.config import RigTable
from estune.errors import EstuneError, PlantError, RigError
from estune.remote import zenoh
from estune.remote.security import Security
from estune.remote.zenoh import RemoteRig
from estune.run.targets import is_endpoint, open_target
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest, empty_record
from estune.trial.record_checks import record_fault

GIVE_UP_AFTER = 5
"""So many trials that came to nothing, one after the other, are no accident."""

HOLDER = "estune daemon"
"""How a daemon's name as the holder of a rig begins."""

_CUT_AGAIN_S = 0.05
_log = logging.getLogger(__name__)


class Refused(RigError):
    """Another daemon supervises the rig."""


class TooManyVoidTrials(RigError):
    """The rig is there, but its trials come to nothing time and again."""


class VoidTrialCounter:
    """Counts trials that came to nothing, one after the other.

    It outlasts a rig that is lost: one whose program ends in each trial is to be given up, too.
    """

    def __init__(self) -> None:
        self._void_in_a_row = 0

    def tell(self, record: TrialRecord) -> None:
        """Counts a trial.

        Raises:
            GivenUp: it is one too many.
        """
        self._void_in_a_row = self._void_in_a_row + 1 if record.outcome.is_void else 0
        if self._void_in_a_row >= GIVE_UP_AFTER:
            self._void_in_a_row = 0
            raise TooManyVoidTrials(
                f"{GIVE_UP_AFTER} trials in a row came to nothing, the last {record.trial_id}: "
                f"{record.reason}; see what stops them, then resume"
            )


class RigAccess:
    """A rig that was reached; made by `reach`.

    Attributes:
        about: What it says of itself, as last heard.
    """

    def __init__(self, rig: Rig, opened: ExitStack, patience: VoidTrialCounter) -> None:
        self._rig = rig
        self._opened = opened
        self._patience = patience
        self.about = rig.describe()

    def describe(self) -> RigDescription:
        """What it is, and which gains are live now."""
        self.about = self._rig.describe()
        return self.about

    def take(self) -> RigDescription:
        """Takes the right to command it, and ends whatever trial an earlier self left under way.

        Raises:
            Refused: another daemon holds it.
            RigError: somebody else does, or it cannot be reached.
        """
        if isinstance(self._rig, RemoteRig):
            try:
                self._rig.acquire()
            except RigError as error:
                holder = self._rig.status().holder
                if holder.startswith(HOLDER):
                    raise Refused(f"held by {holder}; stop one of the two daemons") from error
                raise
        self.about = self._rig.abort()
        return self.about

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones, and sees that they are.

        Raises:
            RigError: it refuses them, or says that others are live.
        """
        self._rig.apply(gains)
        if self.describe().gains != gains:
            raise RigError(
                f"rig {self.about.name} was given {gains} and says that others are live: "
                f"{self.about.gains}"
            )

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs a trial. A record that cannot be what was asked for counts as none.

        Neither does one in which the rig's own program failed: it would say so for ever, asked by
        the same id. On a rig that moves that is a trial cut off.

        Raises:
            RigError: the rig cannot be asked.
            GivenUp: its trials come to nothing time and again.
        """
        try:
            record = self._rig.run(request)
        except EstuneError as error:
            if not self._has_failed(request, error):
                raise
            outcome = Outcome.CANCELLED if self.about.simulated else Outcome.INTERRUPTED
            record = self._nothing(request, outcome, str(error))
        fault = record_fault(record, request, self.about)
        if fault:
            said = f"the record of trial {request.trial_id} is refused: {fault}"
            record = self._nothing(request, Outcome.CANCELLED, said)
        self._patience.tell(record)
        return record

    def _has_failed(self, request: TrialRequest, error: EstuneError) -> bool:
        """Whether a trial can never run under its id."""
        if not isinstance(self._rig, RemoteRig):
            return isinstance(error, PlantError)
        try:
            return self._rig.has_failed(request)
        except EstuneError:  # it is gone: what has become of the trial is seen when it is back
            return False

    def _nothing(self, request: TrialRequest, outcome: Outcome, said: str) -> TrialRecord:
        _log.error("%s", said, extra={"rig": self.about.name})
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        return empty_record(request, self.about, outcome, said, at)

    def latched(self) -> str:
        """Why its emergency stop was called; empty if it was not, was cleared, or is not known."""
        if isinstance(self._rig, RemoteRig):
            with suppress(EstuneError):
                return self._rig.status().latched
        return ""

    def cut(self, while_: Callable[[], bool]) -> None:
        """Ends the trial under way, and any that is just being begun, so long as there may be."""
        with suppress(EstuneError):
            while while_():
                self._rig.abort()
                time.sleep(_CUT_AGAIN_S)

    def release(self) -> None:
        """Lets others command it."""
        if isinstance(self._rig, RemoteRig):
            self._rig.release()

    def close(self) -> None:
        """Lets go of it."""
        self._opened.close()

    @property
    def as_rig(self) -> Rig:
        """The rig, with records looked at before they are handed on."""
        return _Inspected(self, self._rig)


class _Inspected:
    """A rig whose records are looked at."""

    def __init__(self, reached: RigAccess, rig: Rig) -> None:
        self.run = reached.run
        self.describe = reached.describe
        self.apply = reached.apply
        self.abort = rig.abort
        self.estop = rig.estop
        self.clear = rig.clear
        self.close = reached.close


def open_rig(
    settings: RigTable, holder: str, patience: VoidTrialCounter, security: Security
) -> RigAccess:
    """Reaches a rig.

    Args:
        settings: Which.
        holder: Who commands it, for others to be told.
        patience: What is told how its trials end.
        security: Who this is, where the rig asks.

    Raises:
        RigError: it is not there.
        InvalidInput: the target is none.
    """
    with ExitStack() as opened:
        if is_endpoint(settings.target):
            remote = zenoh.connect(
                *(settings.target, settings.name, settings.answer_within_s),
                holder=holder,
                security=security,
            )
            opened.callback(remote.close)
            rig: Rig = remote
        else:
            rig = opened.enter_context(open_target(settings.target, settings.name))
        return RigAccess(rig, opened.pop_all(), patience)
