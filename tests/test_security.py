"""Authentication and access control, by password and by certificate."""

import re
import shutil
import socket
import ssl
import subprocess
import time
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest

from estune.cli import run
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.messages import VERBS
from estune.remote.messages.rights import Right
from estune.remote.security import OPEN, read_security
from estune.remote.state_machine.state import Mode
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.run.trial_file import TrialFile
from estune.trial import Outcome
from estune.web.board import Board
from estune.web.rig_reader import RigReader
from tests.support_daemon import daemon, rig_table
from tests.support_rigs import ScriptedRig, description
from tests.test_bus import trial

SOON_S = 1.0
CONNECTIONS = 300
# Promised in docs/how-to/security.md. A listener that waits 100 ms for each of the 300 needs 30 s.
NEWCOMER_S = 2.0


def secret(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o600)


def security(path: Path, text: str):
    path.write_text(text)
    return read_security(path)


@contextmanager
def served(endpoint: str, **options):
    limited = replace(description().controller, output_max_N=100.0)
    rig = ScriptedRig(duration_s=0.02, controller=limited)
    with zenoh.serve(rig, endpoint, **options) as server:
        yield rig, server


# --- passwords ---

ACCESS = '[access]\ncommand = ["anna"]\nstop = ["ben"]\nlook = ["guest"]\n'
HOLDERS = {"anna": Right.COMMAND, "ben": Right.STOP, "guest": Right.LOOK}


@pytest.fixture
def users(tmp_path):
    """Settings of the rig, of anna, of a guest, of a liar and of a stranger."""
    secret(tmp_path / "users", "anna:horse battery\nben:halt\nguest:look\nstranger:odd\n")
    given = {"anna": "horse battery", "ben": "halt", "guest": "look"}
    given |= {"liar": "wrong", "stranger": "odd"}
    found = {"rig": security(tmp_path / "rig.toml", f'[password]\nusers_file = "users"\n{ACCESS}')}
    for name, word in given.items():
        secret(tmp_path / f"{name}.password", word)
        user = "anna" if name == "liar" else name
        text = f'[password]\nuser = "{user}"\npassword_file = "{name}.password"\n'
        found[name] = security(tmp_path / f"{name}.toml", text)
    return found


def test_user_with_command_right_commands_by_password(users):
    with (
        served("tcp/127.0.0.1:0", security=users["rig"]) as (rig, server),
        zenoh.connect(server.endpoint, security=users["anna"]) as anna,
    ):
        assert anna.run(trial()).outcome is Outcome.DONE
        assert anna.abort() == anna.describe()
        anna.estop("smoke")
        anna.clear()
        assert rig.requests == [trial()]
        assert [p.rig for p in zenoh.discover_rigs(server.endpoint, security=users["anna"])] == [
            "scripted"
        ]


def test_user_with_look_right_sees_all_and_commands_nothing(users):
    with (
        served("tcp/127.0.0.1:0", security=users["rig"]) as (rig, server),
        zenoh.connect(server.endpoint, timeout_s=SOON_S, security=users["guest"]) as guest,
    ):
        assert guest.describe() == rig.describe()
        assert guest.status().mode is Mode.IDLE
        for call in (
            *(lambda: guest.run(trial()), lambda: guest.apply(trial().gains)),
            *(guest.abort, guest.clear),
        ):
            with pytest.raises(RigError, match="had no right to command it"):
                call()
        with pytest.raises(RigError, match="has not answered the emergency stop"):
            guest.estop("smoke")
        assert rig.requests == []
        assert server._handler.status().mode is Mode.IDLE


def test_user_with_look_right_cannot_publish_as_the_rig(users):
    with (
        served("tcp/127.0.0.1:0", security=users["rig"]) as (_, server),
        zenoh.connect(server.endpoint, security=users["anna"]) as anna,
        zenoh.connect(server.endpoint, security=users["guest"]) as guest,
    ):
        anna._at_rest.clear()
        guest._connection.session.put(guest._connection.keys.status, b"forged")
        guest._connection.session.liveliness().declare_token(
            guest._connection.keys.alive("0badf00d")
        )
        assert anna.run(trial()).outcome is Outcome.DONE
        found = zenoh.discover_rigs(server.endpoint, security=users["anna"])
        assert [p.instance for p in found] == [server.instance]


@pytest.mark.parametrize("who", ["liar", None])
def test_client_with_no_or_wrong_password_is_rejected(users, who):
    with served("tcp/127.0.0.1:0", security=users["rig"]) as (_, server):
        given = {} if who is None else {"security": users[who]}
        with pytest.raises(RigError, match="see --security"):
            zenoh.connect(server.endpoint, timeout_s=SOON_S, **given)


def test_user_without_rights_does_not_see_the_rig(users):
    with (
        served("tcp/127.0.0.1:0", security=users["rig"]) as (_, server),
        pytest.raises(RigError, match="no rig answers"),
    ):
        zenoh.connect(server.endpoint, timeout_s=SOON_S, security=users["stranger"])


@pytest.mark.parametrize(("who", "code"), [("anna", 0), ("guest", RigError.exit_code)])
def test_run_experiment_requires_the_command_right(who, code, users, tmp_path):
    file = TrialFile("step", description().step).write(tmp_path)
    with served("tcp/127.0.0.1:0", security=users["rig"]) as (rig, server):
        words = ["run-experiment", str(file), server.endpoint, "--data", str(tmp_path / "data")]
        assert run([*words, "--security", str(tmp_path / f"{who}.toml")]) == code
        assert len(rig.requests) == (code == 0)


def test_improve_requires_the_command_right(users, tmp_path, capsys):
    with served("tcp/127.0.0.1:0", security=users["rig"]) as (rig, server):
        words = ["improve-model", server.endpoint, "--folder", str(tmp_path / "runs"), "--quiet"]
        guest = ["--security", str(tmp_path / "guest.toml")]
        assert run([*words, *guest]) == RigError.exit_code
        assert "had no right to command it" in capsys.readouterr().err
        assert rig.requests == []


def test_daemon_authenticates_at_the_rig(users, tmp_path):
    with served("tcp/127.0.0.1:0", security=users["rig"]) as (_, server):
        table = rig_table("scripted", server.endpoint)
        with daemon(tmp_path / "a", table) as it:
            it.until(lambda s: "requires authentication" in s.trouble, "scripted")
        with daemon(tmp_path / "b", table, security=users["anna"]) as it:
            it.until_mode("tuning", "scripted")


def test_daemon_commands_require_the_command_right(users, tmp_path, capsys):
    with served("tcp/127.0.0.1:0") as (_, server):
        table, more = rig_table("scripted", server.endpoint), 'security = "rig.toml"'
        with daemon(tmp_path, table, more=more, client=users["anna"]) as it:
            it.until_mode("holding", "scripted")
            words, guest = (
                ["daemon-control", "reject", it.service.endpoint],
                tmp_path / "guest.toml",
            )
            assert run([*words, "--security", str(guest)]) == RigError.exit_code
            assert "has the right to make it" in capsys.readouterr().err
            assert run(words) == RigError.exit_code
            assert "see --security" in capsys.readouterr().err
            with DaemonClient(it.service.endpoint, security=users["guest"]) as looking:
                assert looking.status("scripted").mode == "holding"
            assert run([*words, "--security", str(tmp_path / "anna.toml")]) == 0


# --- certificates ---


def openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


def authority(folder: Path, name: str) -> None:
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-subj", f"/CN={name}", "-days", 1),
        *("-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem"),
    )


_USUAL = "subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n"
EXTENSIONS = {
    "old": "",
    "bare": "basicConstraints=CA:FALSE\n",
    "server": f"{_USUAL}extendedKeyUsage=serverAuth\n",
    "client": f"{_USUAL}extendedKeyUsage=clientAuth\n",
}
DATES = {"expired": ("20200101000000Z", "20210101000000Z"), "early": ("20900101000000Z",) * 2}
AUTHORITY = """\
[ca]
default_ca = it
[it]
database = index
new_certs_dir = .
default_md = sha256
rand_serial = yes
policy = any
[any]
commonName = supplied
"""


def certificate(folder: Path, name: str, signer: str) -> None:
    """A key and a certificate of that name, for the loopback address unless it is bare."""
    request, extension = folder / f"{name}.csr", folder / f"{name}.ext"
    extension.write_text(EXTENSIONS.get(name, _USUAL))
    openssl(
        *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-subj", f"/CN={name}", "-keyout", folder / f"{name}.key", "-out", request),
    )
    openssl(
        *("x509", "-req", "-in", request, "-days", 1, "-extfile", extension),
        *("-CA", folder / f"{signer}.pem", "-CAkey", folder / f"{signer}.key", "-CAcreateserial"),
        *("-out", folder / f"{name}.pem"),
    )
    (folder / f"{name}.key").chmod(0o600)
    if name in DATES:
        (folder / "index").write_text("")
        (folder / "ca.cnf").write_text(AUTHORITY)
        begin, end = DATES[name]
        words = ("ca", "-batch", "-notext", "-config", "ca.cnf", "-startdate", begin)
        words += ("-enddate", end, "-extfile", f"{name}.ext", "-in", f"{name}.csr")
        words += ("-cert", f"{signer}.pem", "-keyfile", f"{signer}.key", "-out", f"{name}.pem")
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="module")
def holders(tmp_path_factory):
    """Settings with certificates; the forger's is signed by another authority."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    folder = tmp_path_factory.mktemp("certificates")
    for name in ("ca", "other"):
        authority(folder, name)
    found = {}
    for name in ("rig", *HOLDERS, "forger", *EXTENSIONS, *DATES):
        signer = "other" if name == "forger" else "ca"
        certificate(folder, name, signer)
        text = (
            f'[tls]\nauthority = "{signer}.pem"\ncertificate = "{name}.pem"\nkey = "{name}.key"\n'
        )
        found[name] = security(folder / f"{name}.toml", text + ACCESS * (name == "rig"))
    mixed = '[tls]\nauthority = "ca.pem"\ncertificate = "anna.pem"\nkey = "guest.key"\n'
    found["mixed"] = security(folder / "mixed.toml", mixed)
    return found


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
        assert time.monotonic() - began_s < 0.5
        with zenoh.connect(server.endpoint, security=anna) as newcomer:
            newcomer.estop("smoke again")
        assert time.monotonic() - began_s < NEWCOMER_S


# --- the table of verbs and rights ---


@pytest.mark.parametrize("way", ["users", "holders"])
@pytest.mark.parametrize(("who", "right"), HOLDERS.items())
def test_right_includes_the_verbs_of_the_table_and_no_others(way, who, right, request):
    known = request.getfixturevalue(way)
    scheme = "tls" if way == "holders" else "tcp"
    with (
        served(f"{scheme}/127.0.0.1:0", security=known["rig"]) as (_, server),
        zenoh.connect(server.endpoint, security=known[who]) as client,
    ):
        link = client._connection
        keys = {verb: link.keys.command(link.instance, verb) for verb in VERBS}
        answered = {verb for verb, key in keys.items() if link.ask(key, b"{}")}
        assert answered == {name for name, verb in VERBS.items() if right.includes(verb.right)}
        assert client.right is right
        reader = RigReader(Board(), lambda: client)
        reader.read()
        assert reader.board.get("right") == right
        reader.release()


# --- the file ---


@pytest.mark.parametrize(
    ("text", "complaints"),
    [
        ('[pasword]\nuser = "a"\n', ["pasword", "did you mean password"]),
        ('[password]\nuser = "a"\n', ["user and password_file"]),
        ("[password]\n", ["give user and password_file to connect"]),
        ('[access]\nlook = ["a"]\n', ["without password or tls"]),
        ('[password]\nusers_file = "none"\n', ["password.users_file: there is no file"]),
        (
            '[password]\nusers_file = "open"\n',
            ["password.users_file: others can read", "chmod 600"],
        ),
        ('[tls]\nauthority = 3\nkey = "k"\n', ["tls.key: there is no file"]),
        ("[tls]\nauthority = 3\n", ["tls.authority", "tls.certificate", "tls.key"]),
        ("[tls", ["no TOML"]),
    ],
)
def test_wrong_security_file_lists_its_faults(tmp_path, text, complaints):
    (tmp_path / "open").write_text("anna:secret\n")
    (tmp_path / "open").chmod(0o644)
    with pytest.raises(InvalidInput) as refused:
        security(tmp_path / "security.toml", text)
    for complaint in complaints:
        assert complaint in str(refused.value)
