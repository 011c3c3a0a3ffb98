"""Authentication and access control by password, and the file of both."""

import pytest

from estune.cli import run
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.state_machine.state import Mode
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.run.trial_file import TrialFile
from estune.trial import Outcome
from tests.support_daemon import daemon, rig_table
from tests.support_rigs import description
from tests.support_security import ACCESS, HOLDERS, check_verbs, secret, security, served
from tests.test_bus import trial

SOON_S = 1.0


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


@pytest.mark.parametrize("who", HOLDERS)
def test_right_includes_the_verbs_of_the_table_and_no_others(users, who):
    check_verbs(users, "tcp", who)


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
