"""Daemons with the same rigs: who holds a rig, and what is taken over with it."""

import tomllib

import pytest

from estune.daemon.config import config_from
from estune.daemon.rig_access import (
    HeldByOtherDaemon,
    VoidTrialCounter,
    open_rig,
)
from estune.daemon.store import DaemonStore
from estune.errors import ProtocolError, RigError
from estune.remote import zenoh
from estune.remote.zenoh.network import Network
from estune.remote.zenoh.request_handler import RequestHandler
from tests.support_daemon import (
    ORIGINAL,
    WITHIN_S,
    daemon,
    rig_served,
    rig_table,
)


def test_second_daemon_is_refused_with_the_holders_name(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path / "a", rig_table("drum", where)) as it:
        it.until_mode("holding")
        with (
            pytest.raises(RigError, match="written by another process"),
            daemon(tmp_path / "a", rig_table("drum", where)),
        ):
            pass
        with daemon(tmp_path / "b", rig_table("drum", where)) as other:
            other.thread.join(WITHIN_S)
            assert len(other.failed) == 1
            assert "held by estune daemon" in str(other.failed[0])
        assert it.client.status("drum").mode == "holding"


def _held(status) -> bool:
    return status.mode == "waiting" and "held by estune daemon" in status.trouble


def _accepted(folder):
    """Gains that an ended daemon left accepted; those live on the rig may be a trial's by now."""
    store = DaemonStore.read(folder / "estune-state" / "drum")
    try:
        return store.gains()["accepted"]
    finally:
        store.close()


def test_shared_rig_is_taken_over_with_its_gains_and_its_original_ones(tmp_path):
    with rig_served() as (_, where):
        table = rig_table("drum", where, accept="auto")
        with daemon(tmp_path / "one", table, top="shared = true") as one:
            one.until_mode("watching")
            with daemon(tmp_path / "two", table, top="shared = true") as two:
                two.until(_held)
                one.service.stop()
                one.thread.join(WITHIN_S)
                taken = two.until(lambda s: "accepted" in s.gains)
                assert taken.gains["original"] == ORIGINAL
                first = next(
                    row for row in two.client.history("drum").gains if row["name"] != "original"
                )
                assert first["P"] == _accepted(tmp_path / "one").P
                assert "left it these" in first["why"]
                two.until_mode("watching")
                with daemon(tmp_path / "one", table, top="shared = true") as again:
                    again.until(_held)
                    two.service.stop()
                    two.thread.join(WITHIN_S)
                    taken = again.until(lambda status: "had the rig before" in status.why)
                    assert taken.gains["accepted"] == _accepted(tmp_path / "two") != ORIGINAL
        assert one.failed == two.failed == []


@pytest.mark.parametrize("keeps", [True, False], ids=["kept", "not kept"])
def test_daemon_that_never_met_the_other_reverts_to_the_true_original_gains(
    keeps, tmp_path, monkeypatch
):
    if not keeps:  # a rig that does not know the field

        def decode(verb, payload, known=RequestHandler._decode):
            if b'"original"' in payload:
                raise ProtocolError("SetGains message: original: Unexpected keyword argument")
            return known(verb, payload)

        monkeypatch.setattr(RequestHandler, "_decode", staticmethod(decode))
    with rig_served() as (rig, where):
        table = rig_table("drum", where, accept="auto")
        with daemon(tmp_path / "one", table, top="shared = true") as one:
            accepted = one.until_mode("watching").gains["accepted"]
        with daemon(tmp_path / "two", table, top="shared = true") as two:
            two.until(lambda status: bool(status.live))  # announced to others by then
            two.command("revert")
            two.until(lambda status: status.live == "original")
        assert rig.describe().gains == (ORIGINAL if keeps else accepted)


def test_rigs_beyond_rigs_max_wait_for_a_place(tmp_path):
    with rig_served("a") as (_, a), rig_served("b") as (_, b):
        tables = [rig_table(name, where) for name, where in (("a", a), ("b", b))]
        with daemon(tmp_path, *tables, top="rigs_max = 1") as it:
            modes = {"waiting", "holding"}
            it.until(lambda _: {s.mode for s in it.client.statuses()} == modes, "a")
            (waiting,) = (s for s in it.client.statuses() if s.mode == "waiting")
            assert "rigs_max" in waiting.sentence


def test_lease_of_this_daemon_is_taken_again_and_one_of_another_is_not(tmp_path):
    config = config_from(tomllib.loads(rig_table("drum", "tcp/127.0.0.1:1")), "test", tmp_path)
    with rig_served() as (_, where), zenoh.connect(where, holder="estune daemon a") as first:
        settings = config.rig[0].model_copy(update={"target": where})
        first.acquire()
        for holder, refused in (("estune daemon a", RigError), ("b", HeldByOtherDaemon)):
            counter, network = VoidTrialCounter(), Network()
            access = open_rig(settings, holder, counter, network)
            with pytest.raises(refused) as raised:
                access.acquire()
            assert isinstance(raised.value, HeldByOtherDaemon) == (refused is HeldByOtherDaemon)
            access.close()
