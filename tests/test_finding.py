"""Who finds a rig over Zenoh, and who does not: the link is closed unless it is opened."""

import json
import socket
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import Keys, Lease, Submit, digest
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh import connect, serve
from estune.remote.zenoh.discovery import RECORDS_MAX_BYTES
from estune.remote.zenoh.zenoh_session import open_session, with_port
from estune.trial import Outcome
from tests.serve_rig import served
from tests.support_rigs import ScriptedRig, response, same
from tests.test_bus import SOON_S, trial


@contextmanager
def session(role: str, endpoint: str):
    """A session beside the ones under test; a router where the role is `listen`."""
    ends = {"listen" if role == "listen" else "connect": (endpoint,)}
    opened = open_session(
        "peer" if role == "listen" else "client", message_max_bytes=RECORDS_MAX_BYTES, **ends
    )
    try:
        yield opened
    finally:
        opened.close()


@contextmanager
def router():
    """A Zenoh router of the test's own, and its endpoint."""
    endpoint = with_port("tcp/127.0.0.1:0")
    closed = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    config = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": closed}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))):
        yield endpoint


def forever(call) -> None:
    """Calls until the call raises: for what another process is about to bring about."""
    while True:
        call()


def test_the_only_rig_is_found_and_so_is_the_one_named():
    with served("scripted", "drum") as server:
        for name in (None, "drum"):
            with connect(server.endpoint, rig=name) as rig:
                assert rig.describe().name == rig.name == "drum"


def test_several_rigs_behind_a_router_are_told_apart_by_name():
    with (
        router() as hub,
        served("scripted", "a", "tcp/127.0.0.1:0", hub),
        served("scripted", "b", "tcp/127.0.0.1:0", hub),
    ):
        for name in "ab":
            with connect(hub, rig=name) as rig:
                assert rig.run(trial()).rig == name
        with pytest.raises(RigError, match=r"2 rigs at .*: a, b; name the one"):
            connect(hub, timeout_s=SOON_S)
        with pytest.raises(RigError, match=r"no rig named 'c' at .*; there is: a, b"):
            connect(hub, rig="c", timeout_s=SOON_S)


def test_one_name_served_by_two_processes_is_refused():
    with (
        router() as hub,
        served("scripted", "a", "tcp/127.0.0.1:0", hub),
        connect(hub, rig="a") as early,
        served("scripted", "a", "tcp/127.0.0.1:0", hub),
    ):
        with pytest.raises(RigError, match=r"2 processes at .* serve a rig named 'a'"):
            forever(lambda: connect(hub, rig="a", timeout_s=SOON_S).close())
        assert same(early.run(trial()), replace(response(trial()), rig="a"))


def test_where_nothing_listens_the_error_says_so():
    endpoint = with_port("tcp/127.0.0.1:0")
    with pytest.raises(RigError, match=rf"nothing .* listens at {endpoint}; start a rig"):
        connect(endpoint, timeout_s=SOON_S)


def test_a_listener_that_does_not_speak_zenoh_is_not_taken_for_a_rig():
    with (
        socket.create_server(("127.0.0.1", 0)) as mute,
        pytest.raises(RigError, match="nothing that speaks Zenoh listens"),
    ):
        connect(f"tcp/127.0.0.1:{mute.getsockname()[1]}", timeout_s=SOON_S)


def test_where_there_is_no_rig_the_error_says_so():
    with router() as hub, pytest.raises(RigError, match=f"no rig answers at {hub}; start one"):
        connect(hub, timeout_s=SOON_S)


def test_a_rig_of_another_protocol_version_is_named():
    endpoint = with_port("tcp/127.0.0.1:0")
    with session("listen", endpoint) as later:
        token = later.liveliness().declare_token("reel/v2/drum/alive/0f")
        with pytest.raises(
            ProtocolError, match=r"'drum' at .* speaks protocol v2, this estune v1"
        ):
            connect(endpoint)
        token.undeclare()


@pytest.mark.parametrize(
    "endpoint", ["", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:70000", "tcp/a b:1"]
)
def test_what_is_no_endpoint_is_refused(endpoint):
    with pytest.raises(InvalidInput, match="write it as tcp/host:port"):
        connect(endpoint)
    with pytest.raises(InvalidInput, match="write it as tcp/host:port"):
        serve(ScriptedRig(), endpoint)


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_timeout_that_is_none_is_refused(timeout_s):
    with pytest.raises(InvalidInput, match="timeout is"):
        connect("tcp/127.0.0.1:7447", timeout_s=timeout_s)


# --- closed defaults ---


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:0", "tcp/[::]:0", "tcp/192.0.2.1:7447"])
def test_a_rig_is_not_shown_to_the_network_unless_asked_for(endpoint):
    with pytest.raises(InvalidInput, match="any machine on the network"):
        serve(ScriptedRig(), endpoint)


def test_a_rig_is_shown_to_the_network_where_that_is_asked_for():
    with serve(ScriptedRig(), "tcp/0.0.0.0:0", allow_remote=True) as server:
        assert server.endpoint.startswith("tcp/0.0.0.0:")


def test_a_port_that_is_taken_is_named():
    with (
        serve(ScriptedRig()) as server,
        pytest.raises(RigError, match=f"cannot listen at {server.endpoint}: address already in"),
    ):
        serve(ScriptedRig(), server.endpoint)


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux's socket tables")
def test_a_server_has_one_socket_open_to_others_and_that_on_this_machine_only():
    with served("scripted") as server:
        process = Path("/proc") / str(server.process.pid)
        mine = {str(fd.readlink()) for fd in (process / "fd").iterdir()}
        found = []
        for table in ("tcp", "tcp6", "udp", "udp6"):
            for line in (process / "net" / table).read_text().splitlines()[1:]:
                _, local, _, state, *rest = line.split()
                listening = state == "0A" or table.startswith("udp")
                if listening and f"socket:[{rest[5]}]" in mine:
                    found.append((table, local))
        port = int(server.endpoint.rpartition(":")[2])
        assert found == [("tcp", f"0100007F:{port:04X}")]


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="reads Linux's memory tables")
def test_no_process_on_the_link_shares_memory_or_listens_for_multicast():
    with served("scripted") as server, connect(server.endpoint) as client:
        client.run(trial(duration_s=4.9))  # a record that would be passed in shared memory
        for process in (Path("/proc") / str(server.process.pid), Path("/proc/self")):
            assert ".zenoh" not in (process / "maps").read_text()  # as its segments are named
            mine = {str(fd.readlink()) for fd in (process / "fd").iterdir() if fd.is_symlink()}
            for table in ("udp", "udp6"):
                for line in (process / "net" / table).read_text().splitlines()[1:]:
                    assert f"socket:[{line.split()[9]}]" not in mine


def test_no_wildcard_reaches_a_command():
    rig = ScriptedRig()
    with serve(rig) as server, session("connect", server.endpoint) as snoop:
        lease = server._attendant.lease(Lease("acquire", "ab", "the test"))
        assert lease.verdict is ReplyCode.ACCEPTED
        payload = messages.encode(Submit("ab", trial(), digest(trial())))
        for key in ("reel/**", "**", "reel/v1/*/*/*/submit"):
            list(snoop.get(key, payload=payload, target=zenoh.QueryTarget.ALL, timeout=5.0))
        assert rig.asked == []


def test_a_command_that_is_garbage_is_refused_and_harms_nothing():
    rig = ScriptedRig()
    with serve(rig) as server, session("connect", server.endpoint) as vandal:
        keys = Keys(server.name)
        for key in (
            *(keys.command(server.instance, verb) for verb in ("lease", "submit", "cancel")),
            *(keys.command(server.instance, verb) for verb in ("void", "gains", "clear")),
            keys.result("run-00000"),
        ):
            for payload in (b"", b"\xff" * 100, b'{"x":1}', b"[" * 2000, b"x" * 10_000):
                (reply,) = vandal.get(key, payload=payload, timeout=5.0)
                answer = messages.decode(messages.Answer, reply.ok.payload.to_bytes())
                assert (answer.verdict, answer.error) == ("refused", "ProtocolError")
        with connect(server.endpoint) as client:
            assert client.run(trial()).outcome is Outcome.DONE
