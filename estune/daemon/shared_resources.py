"""Resources that the supervisors of one daemon share."""

from typing import NamedTuple

from estune.daemon.admission import Admission
from estune.remote.zenoh.daemon_service import DaemonServer
from estune.remote.zenoh.network import Network


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
