"""Conformance suite of the rig protocol, message by message; see reference/rig-protocol.md."""

import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from estune.conformance.rig_commands import CommandTests
from estune.conformance.rig_trials import TrialTests
from estune.conformance.wire_client import WireClient
from estune.remote.messages.commands import Clear, Lease
from estune.remote.security import OPEN, Security
from estune.remote.state_machine.state import Mode
from estune.remote.zenoh import connect
from estune.remote.zenoh.network import RECORDS_MAX_BYTES
from estune.remote.zenoh.zenoh_session import close_session, open_client
from estune.trial import Outcome

_LISTENS_WITHIN_S = 3.0


class RigConformance(TrialTests, CommandTests):
    """Tests of a rig at an endpoint: the fixture `endpoint`, which a subclass must define.

    The rig moves: it runs its own step, is stopped, and has its emergency stop called.
    """

    @pytest.fixture
    def endpoint(self) -> str:
        """Endpoint of the rig under test, or of a router."""
        raise NotImplementedError("define the fixture `endpoint`: the address of your rig")

    @pytest.fixture
    def rig_name(self) -> str | None:
        """Name of the rig; None for the only one."""
        return None

    @pytest.fixture
    def security(self) -> Security:
        """Credentials of a user with the right to command."""
        return OPEN

    @pytest.fixture
    def wire(
        self, endpoint: str, rig_name: str | None, security: Security
    ) -> Iterator[WireClient]:
        """The rig at rest, with the lease held."""
        with ExitStack() as stack:
            deadline_s = time.monotonic() + _LISTENS_WITHIN_S
            session = open_client(
                endpoint, RECORDS_MAX_BYTES, security, deadline_s, f"a rig at {endpoint}"
            )
            stack.callback(close_session, session)
            wire = WireClient(session, rig_name)
            wire.until(Mode.IDLE, Mode.SAFE, renew=False)
            wire.send("clear", Clear())
            wire.acquire()
            yield wire
            wire.send("lease", Lease("release", wire.lease))

    def test_remote_rig_runs_a_trial(
        self, endpoint: str, wire: WireClient, security: Security
    ) -> None:
        wire.send("lease", Lease("release", wire.lease))
        with connect(endpoint, rig=wire.keys.rig, security=security) as rig:
            trial = wire.trial(7)
            record = rig.run(trial)
            assert (record.trial_id, record.outcome) == (trial.trial_id, Outcome.DONE)
            assert rig.abort() == rig.describe()
        wire.acquire()
