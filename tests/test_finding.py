"""Discovery of rigs over Zenoh, and defaults that keep the link closed."""

import json
import socket
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import VERBS, Keys, digest
from estune.remote.messages.commands import Lease, Submit
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh import connect, serve
from estune.remote.zenoh.endpoints import with_port
from estune.remote.zenoh.network import RECORDS_MAX_BYTES
from estune.remote.zenoh.zenoh_session import open_session
from estune.trial import Outcome
from tests.serve_rig import hosted, served
from tests.support_rigs import ScriptedRig, response, same
from tests.test_bus import SOON_S, trial


@contextmanager
def session(role: str, endpoint: str):
    """A session of the test's own; `listen` makes it a peer that listens."""
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
    """Calls until the call raises: for an event in another process."""
    while True:
        call()


def test_connect_finds_the_only_rig_and_the_one_named():
    with hosted("scripted", "drum") as endpoint:
        for name in (None, "drum"):
            with connect(endpoint, rig=name) as rig:
                assert rig.describe().name == rig.name == "drum"


@pytest.mark.slow
def test_connect_selects_among_rigs_behind_a_router_by_name():
    with (
        router() as hub,
        served("scripted", "a", "tcp/127.0.0.1:0", hub),
        served("scripted", "b", "tcp/127.0.0.1:0", hub),
    ):
        for name in "ab":
            with connect(hub, rig=name) as rig:
                assert rig.run(trial()).rig == name
        with pytest.raises(RigError, match=r"2 rigs at .*: a, b; name one"):
            connect(hub, timeout_s=SOON_S)
        with pytest.raises(RigError, match=r"no rig named 'c' at .*; there is: a, b"):
            connect(hub, rig="c", timeout_s=SOON_S)


def test_connect_to_a_name_served_twice_is_refused():
    with (
        router() as hub,
        hosted("scripted", "a", hub),
        connect(hub, rig="a") as early,
        hosted("scripted", "a", hub),
    ):
        with pytest.raises(RigError, match=r"2 processes at .* serve a rig named 'a'"):
            forever(lambda: connect(hub, rig="a", timeout_s=SOON_S).close())
        assert same(early.run(trial()), replace(response(trial()), rig="a"))


def test_connect_without_a_listener_names_the_remedy():
    endpoint = with_port("tcp/127.0.0.1:0")
    with pytest.raises(RigError, match=rf"nothing .* listens at {endpoint}; start a rig"):
        connect(endpoint, timeout_s=SOON_S)


def test_connect_to_a_listener_without_zenoh_is_refused():
    with (
        socket.create_server(("127.0.0.1", 0)) as mute,
        pytest.raises(RigError, match="does not speak Zenoh"),
    ):
        connect(f"tcp/127.0.0.1:{mute.getsockname()[1]}", timeout_s=SOON_S)


def test_connect_without_a_rig_names_the_remedy():
    with (
        router() as hub,
        pytest.raises(
            RigError, match=f"no rig answers at {hub}, but something there speaks Zenoh"
        ),
    ):
        connect(hub, timeout_s=SOON_S)


def test_connect_to_another_protocol_version_is_refused():
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
def test_malformed_endpoint_is_refused(endpoint):
    with pytest.raises(InvalidInput, match=r"is malformed; (did you mean|write it as) tcp/"):
        connect(endpoint)
    with pytest.raises(InvalidInput, match=r"is malformed; (did you mean|write it as) tcp/"):
        serve(ScriptedRig(), endpoint)


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_invalid_timeout_is_refused(timeout_s):
    with pytest.raises(InvalidInput, match="timeout is"):
        connect("tcp/127.0.0.1:7447", timeout_s=timeout_s)


# --- closed defaults ---


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:0", "tcp/[::]:0", "tcp/192.0.2.1:7447"])
def test_serve_beyond_loopback_is_refused_by_default(endpoint):
    with pytest.raises(InvalidInput, match=r"any machine on the network.*--allow-remote"):
        serve(ScriptedRig(), endpoint)


def test_serve_beyond_loopback_with_allow_remote():
    with serve(ScriptedRig(), "tcp/0.0.0.0:0", allow_remote=True) as server:
        assert server.endpoint.startswith("tcp/0.0.0.0:")


def test_serve_on_a_port_in_use_names_it():
    with (
        serve(ScriptedRig()) as server,
        pytest.raises(RigError, match=f"cannot listen at {server.endpoint}: address already in"),
    ):
        serve(ScriptedRig(), server.endpoint)


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux's socket tables")
def test_server_listens_on_one_loopback_socket_only():
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
def test_link_uses_neither_shared_memory_nor_multicast():
    with served("scripted") as server, connect(server.endpoint) as client:
        client.run(trial(duration_s=4.9))  # a record that would be passed in shared memory
        for process in (Path("/proc") / str(server.process.pid), Path("/proc/self")):
            assert ".zenoh" not in (process / "maps").read_text()  # as its segments are named
            mine = {str(fd.readlink()) for fd in (process / "fd").iterdir() if fd.is_symlink()}
            for table in ("udp", "udp6"):
                for line in (process / "net" / table).read_text().splitlines()[1:]:
                    assert f"socket:[{line.split()[9]}]" not in mine


def test_command_on_a_wildcard_key_is_not_executed():
    rig = ScriptedRig()
    with serve(rig) as server, session("connect", server.endpoint) as snoop:
        lease = server._handler.lease(Lease("acquire", "ab", "the test"))
        assert lease.verdict is ReplyCode.ACCEPTED
        payload = messages.encode(Submit("ab", trial(), digest(trial())))
        for key in ("reel/**", "**", "reel/v1/*/*/*/submit", "reel/v1/*/@cmd/*/submit"):
            list(snoop.get(key, payload=payload, target=zenoh.QueryTarget.ALL, timeout=5.0))
        assert rig.requests == []


def test_random_commands_are_refused_without_effect():
    rig = ScriptedRig()
    with serve(rig) as server, session("connect", server.endpoint) as vandal:
        keys = Keys(server.name)
        for key in (
            *(keys.command(server.instance, verb) for verb in VERBS.keys() - {"estop"}),
            keys.result("run-00000"),
        ):
            for payload in (b"", b"\xff" * 100, b'{"x":1}', b"[" * 2000, b"x" * 10_000):
                (reply,) = vandal.get(key, payload=payload, timeout=5.0)
                answer = messages.decode(messages.Answer, reply.ok.payload.to_bytes())
                assert (answer.verdict, answer.error) == ("refused", "ProtocolError")
        with connect(server.endpoint) as client:
            assert client.run(trial()).outcome is Outcome.DONE
