"""Connection of a supervisor to its rig, within the admission of all rigs of the daemon."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from estune.daemon import rig_access
from estune.daemon.admission import Admission
from estune.daemon.config import RigTable
from estune.daemon.rig_access import RigAccess
from estune.daemon.supervised_rig import Preempted, SupervisedRig
from estune.daemon.supervisor_state import SupervisorMode
from estune.errors import EstuneError, RigError
from estune.remote.zenoh.daemon_service import DaemonServer
from estune.remote.zenoh.network import Network

TRIAL_MODES = (SupervisorMode.TUNING, SupervisorMode.CONFIRMING, SupervisorMode.WATCHING)


class SharedResources(NamedTuple):
    """Resources that the supervisors of a daemon have in common.

    Attributes:
        holder: Name of the daemon as the holder of leases.
        instance: Identity of this start of it.
        fleet: Where a rig that this daemon has is announced to the other daemons that have it in
            their files; None if there are none.
        stop_within_s: Time that a stop waits for a rig that does not answer.
    """

    holder: str
    instance: str
    network: Network
    admission: Admission
    fleet: DaemonServer | None
    stop_within_s: float

    @property
    def are_rigs_shared(self) -> bool:
        """Whether other daemons have the same rigs in their files."""
        return self.fleet is not None


class SupervisedConnection:
    """Connection to a rig: opened, lost and opened again.

    Attributes:
        access: The rig while it is connected, or None.
    """

    def __init__(
        self,
        settings: RigTable,
        rig: SupervisedRig,
        shared: SharedResources,
        wait: Callable[[str], None],
    ) -> None:
        """Connects nothing yet; `wait` is called with the reason while a trial waits its turn."""
        self.access: RigAccess | None = None
        self._settings = settings
        self._rig = rig
        self._shared = shared
        self._wait = wait
        self._void_trials = rig_access.VoidTrialCounter()
        self._in_trial = False

    def open(self) -> RigAccess:
        """Connects to the rig anew.

        Raises:
            EstuneError: it does not answer, or is held by others.
        """
        self.close()
        self._rig.live = None
        shared = self._shared
        shared.admission.take_place(self._settings.name)
        with shared.admission.connecting(self._settings.answer_within_s):
            self.access = rig_access.open_rig(
                *(self._settings, shared.holder, self._void_trials, shared.network),
                turn=self._turn,
                counts=self._rig.counts,
                notes=self._rig.store,
            )
        return self.access

    def required(self) -> RigAccess:
        """The rig.

        Raises:
            RigError: it is not connected.
        """
        if self.access is None:
            raise RigError(f"rig {self._settings.name} is not connected")
        return self.access

    def close(self) -> None:
        """Leaves the rig and its place in the admission, if there is a connection."""
        access, self.access = self.access, None
        if access is not None:
            with suppress(EstuneError):
                access.close()
        self._shared.admission.leave_place(self._settings.name)
        if self._shared.fleet is not None:
            self._shared.fleet.withdraw(self._settings.name)

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if self._rig.mode not in TRIAL_MODES:
            raise Preempted
        with self._shared.admission.trial(self._wait):
            yield

    @contextmanager
    def trials(self) -> Iterator[None]:
        """Block of trials, which a stop ends at once."""
        self._in_trial = True
        try:
            if self._rig.mode not in TRIAL_MODES:
                raise Preempted
            yield
        finally:
            self._in_trial = False

    def abort_trial(self) -> None:
        """Ends the trial under way, if any, without waiting."""
        access = self.access
        if self._in_trial and access is not None:
            abort, while_ = access.abort_trials, lambda: self._in_trial
            threading.Thread(target=abort, args=(while_,), daemon=True).start()
