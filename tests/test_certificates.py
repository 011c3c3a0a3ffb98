"""Authentication and access control by certificate."""

import re
import shutil
import socket
import ssl
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.security import OPEN
from estune.trial import Outcome
from tests.support_rigs import ScriptedRig
from tests.support_security import (
    HOLDERS,
    certified,
    check_verbs,
    openssl,
    security,
    served,
)
from tests.test_bus import trial

SOON_S = 1.0
CONNECTIONS = 300
# A listener that waits 100 ms for each of the 300, as Zenoh's own does, needs 30 s; half of that
# is far more than a busy computer adds. How soon it is, experiments.tls_flood measures.
NEWCOMER_S = 15.0


@pytest.fixture(scope="module")
def holders(tmp_path_factory):
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    return certified(tmp_path_factory.mktemp("certificates"))


def test_certificates_grant_command_and_look_rights(holders):
    with (
        served("tls/127.0.0.1:0", security=holders["rig"]) as (rig, server),
        zenoh.connect(server.endpoint, security=holders["anna"]) as anna,
        zenoh.connect(server.endpoint, timeout_s=SOON_S, security=holders["guest"]) as guest,
    ):
        assert anna.run(trial()).outcome is Outcome.DONE
        assert guest.describe() == anna.describe()
        with pytest.raises(RigError, match="had no right to command it"):
            guest.run(trial(1))
        assert rig.requests == [trial()]


@pytest.mark.parametrize(
    ("who", "fault"),
    [
        ("forger", "certificates: the listener's is signed by an authority .*see --security"),
        ("expired", r"expired\.pem has expired; make a new one"),
        ("early", r"early\.pem is not valid yet; check the clocks"),
        ("server", r"server\.pem is made for the other side"),
        ("old", r"old\.pem is a certificate of version 1; make it anew"),
        ("mixed", "anna.pem and .*guest.key.*MISMATCH"),
    ],
)
def test_client_reports_the_certificate_at_fault(holders, who, fault):
    with (
        served("tls/127.0.0.1:0", security=holders["rig"]) as (_, server),
        pytest.raises(RigError, match=fault),
    ):
        zenoh.connect(server.endpoint, timeout_s=0.1, security=holders[who])


def test_certificate_without_the_rigs_address_is_reported(holders):
    with (
        served("tls/127.0.0.1:0", security=holders["bare"]) as (_, server),
        pytest.raises(RigError, match=r"the listener's is for another address .*'127\.0\.0\.1'"),
    ):
        zenoh.connect(server.endpoint, timeout_s=0.1, security=holders["anna"])


@pytest.mark.parametrize(
    ("rig", "client", "line"),
    [
        ("rig", "expired", "the client's certificate has expired"),
        ("rig", "early", "the client's certificate is not valid yet"),
        ("rig", "server", "the client's certificate is made for the other side"),
        ("rig", "forger", "the client says that this rig's certificate is signed by an authority"),
        (
            "bare",
            "anna",
            "the client says that this rig's certificate is not valid yet, or is for",
        ),
        ("expired", "anna", "the client says that this rig's certificate has expired"),
    ],
)
def test_rig_logs_one_line_on_a_certificate_at_fault(holders, caplog, rig, client, line):
    with served("tls/127.0.0.1:0", security=holders[rig]) as (_, server):
        caplog.clear()
        for _ in range(2):
            with pytest.raises(RigError):
                zenoh.connect(server.endpoint, timeout_s=0.1, security=holders[client])
            _shake_hands(server.endpoint, holders[client].tls)
    said = [text for text in caplog.messages if "certificate" in text]
    assert len(said) == 1
    assert said[0].startswith(f"127.0.0.1: {line}")


def _shake_hands(endpoint: str, tls) -> None:
    """A client whose own side is not checked beforehand."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    tls.load_into(context)
    address = "127.0.0.1", int(endpoint.rpartition(":")[2])
    with (
        suppress(OSError),
        socket.create_connection(address) as link,
        context.wrap_socket(link, server_hostname=address[0]) as encrypted,
    ):
        encrypted.recv(1)


@pytest.mark.parametrize(
    ("who", "fault"),
    [
        ("expired", r"accepts .*expired\.pem: it has expired; make a new one"),
        ("early", r"accepts .*early\.pem: it is not valid yet; check the clocks"),
        ("server", r"accepts .*server\.pem: it is made for the other side"),
        ("mixed", r"anna\.pem and .*guest\.key.*MISMATCH"),
        ("forger", r"do not accept each other's certificates; a rig at tls/ says which"),
    ],
)
def test_client_by_quic_reports_its_own_certificate_at_fault(holders, who, fault):
    with (
        served("quic/127.0.0.1:0", security=holders["rig"]) as (_, server),
        pytest.raises(RigError, match=fault),
    ):
        zenoh.connect(server.endpoint, timeout_s=0.1, security=holders[who])


@pytest.mark.parametrize("protocol", ["tls", "quic"])
@pytest.mark.parametrize(("name", "fault"), [("expired", "has expired"), ("client", "other side")])
def test_listener_warns_of_its_own_certificate(holders, caplog, name, fault, protocol):
    with served(f"{protocol}/127.0.0.1:0", security=holders[name]):
        assert any("no client will accept this rig" in m and fault in m for m in caplog.messages)


def test_listener_reports_its_certificate_at_fault(holders):
    with pytest.raises(RigError, match=r"certificate of --security: .*old\.pem is a .* version 1"):
        zenoh.serve(ScriptedRig(), "tls/127.0.0.1:0", security=holders["old"])


@pytest.mark.usefixtures("holders")
def test_commands_of_the_page_make_certificates_that_connect(tmp_path):
    page = (Path(__file__).parents[1] / "docs" / "how-to" / "security.md").read_text("utf-8")
    chapter = page.partition("## Certificates")[2].partition("## What")[0]
    for block in re.findall(r"```bash\n(.*?)```", chapter, re.DOTALL):
        script = block.replace("192.168.1.5", "127.0.0.1")
        subprocess.run(["sh", "-ec", script], cwd=tmp_path, check=True, capture_output=True)
    (toml,) = re.findall(r"```toml\n(.*?)```", chapter, re.DOTALL)
    rig = security(tmp_path / "rig.toml", toml)
    mine = toml.partition("[access]")[0].replace("rig.", "anna.")
    anna = security(tmp_path / "anna.toml", mine)
    for certificate in ("rig.pem", "anna.pem"):  # by the rules of Python from 3.13 on
        openssl("verify", "-x509_strict", "-CAfile", tmp_path / "ca.pem", tmp_path / certificate)
    with (
        served("tls/127.0.0.1:0", security=rig) as (_, server),
        zenoh.connect(server.endpoint, security=anna) as client,
    ):
        assert client.run(trial()).outcome is Outcome.DONE


def test_unencrypted_endpoint_with_certificates_is_refused(holders):
    with pytest.raises(InvalidInput, match=r"write it as tls/127\.0\.0\.1:"):
        zenoh.serve(ScriptedRig(), "tcp/127.0.0.1:0", security=holders["rig"])
    with pytest.raises(InvalidInput, match="needs certificates"):
        zenoh.connect("tls/127.0.0.1:7447")


@pytest.mark.parametrize("what", ["tcp", "tls bare", "tls noise", "tls handshake", "tls left"])
def test_idle_connections_keep_out_neither_a_newcomer_nor_a_stop(holders, what):
    encrypted = what.startswith("tls")
    rig, anna = (holders["rig"], holders["anna"]) if encrypted else (OPEN, OPEN)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # Python 3.13's default is stricter
    holders["anna"].tls.load_into(context)
    with (
        served(f"{'tls' if encrypted else 'tcp'}/127.0.0.1:0", security=rig) as (_, server),
        zenoh.connect(server.endpoint, security=anna) as client,
        ExitStack() as idle,
    ):
        for _ in range(CONNECTIONS):
            address = "127.0.0.1", int(server.endpoint.rpartition(":")[2])
            connection = idle.enter_context(socket.create_connection(address))
            if what == "tls noise":
                connection.sendall(b"\x16\x03\x01" + bytes(1000))
            if what == "tls handshake":
                idle.enter_context(context.wrap_socket(connection, server_hostname=address[0]))
        if what == "tls left":
            idle.close()
        began_s = time.monotonic()
        client.estop("smoke")
        with zenoh.connect(server.endpoint, security=anna) as newcomer:
            newcomer.estop("smoke again")
        assert time.monotonic() - began_s < NEWCOMER_S


@pytest.mark.parametrize("who", HOLDERS)
def test_right_includes_the_verbs_of_the_table_and_no_others(holders, who):
    check_verbs(holders, "tls", who)
