"""What stands around the keepers: the file, systemd, metrics, hooks, logs, messages, records."""

import http.client
import json
import logging
import re
import select
import socket
import subprocess
import sys
import threading
import time
import tomllib
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune import inspection
from estune.cli import run
from estune.core.control_chart import Sign
from estune.daemon.config import DaemonConfig, HookTable, config_from, read_config
from estune.daemon.events import Event, Kind
from estune.daemon.hooks import WAITING_MAX, Hooks
from estune.daemon.keeper import Keeper
from estune.daemon.life import GainSet, Goal, Life
from estune.daemon.logs import JsonLines, PlainLines
from estune.daemon.metrics import METRICS, render, write_metrics
from estune.daemon.store import Store
from estune.daemon.systemd import Notifier
from estune.errors import InvalidInput, JournalError, ProtocolError, RigError
from estune.protocol.daemon import (
    Command,
    CommandAnswer,
    DaemonStatus,
    Request,
    decode_daemon,
    encode_daemon,
)
from estune.trial import Outcome, TrialRequest
from tests.support_daemon import ORIGINAL, WITHIN_S, daemon, rig_served, rig_table
from tests.support_rigs import description, diverged, response, same

ROOT = Path(__file__).parents[1]

WRONG = """
stat = "x"
stop_within_s = -1.0
[service]
listen = "tcp/0.0.0.0:7450"
[metrics]
http_prot = 9464
[[hook]]
command = []
events = ["driftd"]
[[rig]]
name = "a b"
target = "tcp/127.0.0.1:7447"
acept = "ask"
retry_first_s = 100.0
[rig.tuning]
tuner = "otisx"
trials = 0
bounds = {P = [10, 0.1], Q = [1, 2]}
[rig.watch]
smoothing = 2.0
every = 3600
[rig.step]
step_at_s = 0.4
duration_s = 0.2
[rig.cost]
settling_time_s = nan
"""


def test_all_that_is_wrong_in_a_file_is_told_at_once_with_its_place(tmp_path, capsys):
    file = tmp_path / "daemon.toml"
    file.write_text(WRONG)
    assert run(["daemon", str(file)]) == InvalidInput.exit_code
    said = capsys.readouterr().err
    for words in (
        "stat: there is no such key; did you mean state?",
        "stop_within_s: Input should be greater than 0",
        "service: listening at tcp/0.0.0.0:7450 would let any machine",
        "metrics.http_prot: there is no such key; did you mean http_port?",
        "hook.0.command: List should have at least 1 item",
        "hook.0.events.0: Input should be 'started', 'found'",
        "rig.0.name: 'a b' may hold only",
        "rig.0.acept: there is no such key; did you mean accept?",
        "rig.0.retry_first_s: 100 is above retry_max_s 60",
        "rig.0.tuning.tuner: there is none named 'otisx'",
        "rig.0.tuning.trials: Input should be greater than or equal to 1",
        "rig.0.tuning.bounds.P: 10 to 0.1 is no range",
        "rig.0.tuning.bounds.Q: no gain",
        "rig.0.watch: smoothing is 2.0; it must be from 0.01 to 1",
        "rig.0.watch.every: there is no such key; did you mean every_s?",
        "rig.0.step: step_at_s: 0.4 is not before the trial's end",
        "rig.0.cost.settling_time_s: Input should be a finite number",
    ):
        assert words.replace("step: step_at_s", "step.step_at_s") in said, words


@pytest.mark.parametrize(
    ("text", "words"),
    [("rig = []", "at least 1 item"), ("rig = 3 x", "no TOML"), ("", "rig: Field required")],
)
def test_files_that_say_nothing_are_refused(text, words, tmp_path):
    (tmp_path / "d.toml").write_text(text)
    with pytest.raises(InvalidInput, match=words):
        read_config(tmp_path / "d.toml")


def test_the_example_in_the_docs_is_right_and_every_key_is_in_the_docs():
    text = (ROOT / "docs" / "daemon.md").read_text()
    example = re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1]
    config = config_from(tomllib.loads(example), "docs", Path("/etc/estune"))
    assert config.state == Path("/var/lib/estune")

    def rows(table, prefix):
        for name, field in table.model_fields.items():
            inner = next(
                (
                    a
                    for a in (field.annotation, *getattr(field.annotation, "__args__", ()))
                    if hasattr(a, "model_fields")
                ),
                None,
            )
            if inner is None:
                yield f"{prefix}{name}", field
            else:
                yield from rows(inner, f"{prefix}{name}.")

    for key, field in rows(DaemonConfig, ""):
        row = re.search(rf"^\| `{re.escape(key)}` \| ([^|]*) \|", text, re.MULTILINE)
        assert row, f"{key} is not in docs/daemon.md"
        if not field.is_required():
            shown = field.default.as_posix() if isinstance(field.default, Path) else field.default
            assert row[1].strip().strip("`") == (
                "" if shown in (None, [], {}) else json.dumps(shown).strip('"')
            ), key
    for kind in Kind:
        assert f"`{kind}`" in text
    for metric in METRICS:
        assert f"`{metric.name}`" in text


# --- systemd ---


class Manager:
    """systemd's end of the socket."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.settimeout(WITHIN_S)
        self.heard: list[dict[str, str]] = []

    def until(self, name: str, value: str = "") -> dict[str, str]:
        ends = time.monotonic() + WITHIN_S
        while time.monotonic() < ends:
            data = self.socket.recv(65536).decode()
            facts = dict(line.split("=", 1) for line in data.split("\n"))
            self.heard.append(facts)
            if name in facts and value in facts[name]:
                return facts
        raise AssertionError(self.heard[-3:])


@pytest.fixture
def manager(tmp_path):
    made = Manager(str(tmp_path / "notify"))
    yield made
    made.socket.close()


def test_systemd_hears_of_the_start_the_state_life_and_the_end(tmp_path, manager):
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "100000"}
    with rig_served() as (_, where):
        notifier = Notifier(environment)
        with daemon(tmp_path, rig_table("drum", where), notifier=notifier):
            assert "drum: waiting" in manager.until("READY", "1")["STATUS"]
            manager.until("STATUS", "drum: holding, original gains live")
            manager.until("WATCHDOG", "1")
            manager.until("WATCHDOG", "1")
        manager.until("STOPPING", "1")
        manager.until("STATUS", "drum: stopped, original gains live")


def test_a_keeper_that_is_stuck_starves_the_watchdog(tmp_path, manager, monkeypatch):
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "60000"}
    with rig_served() as (_, where):
        notifier = Notifier(environment)
        with daemon(tmp_path, rig_table("drum", where), notifier=notifier) as it:
            it.until_mode("holding")
            manager.until("WATCHDOG", "1")
            keeper = it.service._keepers[0]
            assert not keeper.is_stuck
            monkeypatch.setattr(Keeper, "_beat", lambda _: None)
            keeper._step_at_s -= 1e4
            assert keeper.is_stuck
            time.sleep(0.6)  # what was on its way
            while select.select([manager.socket], [], [], 0.0)[0]:
                manager.socket.recv(65536)
            assert not select.select([manager.socket], [], [], 0.6)[0]


def test_without_systemd_nothing_is_sent_and_another_process_watchdog_is_not_ours():
    Notifier({}).tell(READY=1)
    assert Notifier({}).watchdog_s is None
    assert Notifier({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "1"}).watchdog_s is None
    assert Notifier({"WATCHDOG_USEC": "5000000"}).watchdog_s == 5.0


def test_an_abstract_socket_is_reached_and_line_breaks_forge_nothing():
    name = f"estune-test-{id(object())}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(f"\0{name}")
        Notifier({"NOTIFY_SOCKET": f"@{name}"}).tell(STATUS="one\nREADY=1")
        assert receiver.recv(100) == b"STATUS=one READY=1"


def test_the_unit_is_one_that_systemd_takes(tmp_path):
    unit = (ROOT / "contrib" / "estune-daemon.service").read_text()
    file = tmp_path / "estune-daemon.service"
    file.write_text(unit.replace("/opt/estune/bin/estune", sys.executable))
    try:
        checked = subprocess.run(
            ["systemd-analyze", "verify", file], capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        pytest.skip("systemd-analyze is not installed")
    assert checked.returncode == 0, checked.stderr
    assert "estune-daemon.service" not in checked.stderr.replace("not safe", "")


# --- metrics ---


def status(**changes) -> DaemonStatus:
    plain = DaemonStatus(
        rig="drum",
        instance="1",
        mode="watching",
        sentence="",
        paused="",
        trouble="",
        live="accepted",
        home="accepted",
        why="",
        gains={"original": ORIGINAL, "accepted": ORIGINAL},
        found="",
        run="r",
        trials=30,
        trials_max=40,
        baseline_cost=1.25,
        cost=None,
        drift=-0.5,
        checks=7,
        next_check_s=1.0,
        since="",
    )
    return replace(plain, **changes)


def parsed(text: str) -> dict[tuple[str, frozenset], float]:
    """Prometheus' text format, read strictly."""
    found = {}
    for line in text.removesuffix("\n").split("\n"):
        if line.startswith("#"):
            assert re.fullmatch(r"# (HELP [a-z_]+ .+|TYPE [a-z_]+ (gauge|counter))", line)
            continue
        match = re.fullmatch(r"([a-z_]+)\{(.*)\} (\S+)", line)
        labels = re.findall(r'([a-z]+)="((?:[^"\\\n]|\\.)*)"', match[2])
        key = match[1], frozenset(labels)
        assert key not in found
        found[key] = float(match[3])
    return found


def test_metrics_are_prometheus_text_and_say_what_the_status_says():
    found = parsed(render([status(), status(rig='o"d\\d', mode="paused", live="")]))

    def figure(name, rig="drum", **labels):
        return found[name, frozenset({"rig": rig, **labels}.items())]

    assert figure("estune_mode", mode="watching") == 1.0
    assert figure("estune_mode", mode="paused") == 0.0
    assert figure("estune_gains_live", set="accepted") == 1.0
    assert figure("estune_gain", set="original", gain="P") == ORIGINAL.P
    assert figure("estune_drift_ratio") == -0.5
    assert ("estune_cost_ratio", frozenset({("rig", "drum")})) not in found
    odd = r"o\"d\\d"
    assert all(figure("estune_gains_live", odd, set=s) == 0.0 for s in ("original", "candidate"))


def test_the_metrics_file_is_whole_whenever_it_is_read(tmp_path):
    file, seen, over = tmp_path / "estune.prom", set(), threading.Event()
    write_metrics(file, [status()])

    def read():
        while not over.is_set():
            seen.add(len(parsed(file.read_text())))

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(200):
        write_metrics(file, [status()])
    over.set()
    reader.join()
    assert seen == {len(parsed(render([status()])))}
    assert [path.name for path in tmp_path.iterdir()] == ["estune.prom"]


def test_metrics_are_in_the_file_and_on_loopback(tmp_path):
    more = '[metrics]\nfile = "estune.prom"\nevery_s = 0.05\nhttp_port = 0'
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where), more=more) as it:
        it.until_mode("holding")
        live = "estune_gains_live", frozenset({"rig": "drum", "set": "original"}.items())
        answers = {}
        for path in ("/metrics", "/other"):
            connection = http.client.HTTPConnection("127.0.0.1", it.service.metrics_port)
            connection.request("GET", path)
            answer = connection.getresponse()
            answers[path] = answer.status, answer.read().decode()
            connection.close()
        assert answers["/metrics"][0] == 200
        assert parsed(answers["/metrics"][1])[live] == 1.0
        assert answers["/other"][0] == 404
        while parsed((tmp_path / "estune.prom").read_text()).get(live) != 1.0:
            time.sleep(0.01)


# --- hooks and logs ---


def event(kind=Kind.DRIFTED, number=1) -> Event:
    return Event("drum", number, "2009-05-04T12:00:00+02:00", kind, "the cost", {"cost": 1.5})


def test_hooks_get_the_events_they_ask_for_as_json(tmp_path):
    out = tmp_path / "out"
    hook = HookTable(
        command=["sh", "-c", f"cat >> {out}; echo >> {out}"], events=[Kind.DRIFTED, Kind.LOST]
    )
    hooks = Hooks([hook])
    for kind in (Kind.DRIFTED, Kind.GAINS, Kind.LOST):
        hooks.tell(event(kind))
    hooks.close(WITHIN_S)
    told = [json.loads(line) for line in out.read_text().splitlines()]
    assert [line["kind"] for line in told] == ["drifted", "lost"]
    assert told[0] == {
        "rig": "drum",
        "number": 1,
        "at": "2009-05-04T12:00:00+02:00",
        "kind": "drifted",
        "sentence": "the cost",
        "facts": {"cost": 1.5},
    }


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["sh", "-c", "echo no printer >&2; exit 3"], "code 3 at drifted: no printer"),
        (["/no/such/program"], "cannot be run: No such file"),
        (["sh", "-c", "sleep 1000; true"], "killed after 0.05 s"),
        (["true"], ""),
    ],
)
def test_hooks_that_fail_are_logged(command, words, caplog):
    hooks = Hooks([HookTable(command=command, timeout_s=0.05 if "sleep" in command[-1] else 10.0)])
    hooks.tell(event())
    hooks.close(WITHIN_S)
    assert words in caplog.text
    assert bool(caplog.text) is bool(words)


def test_a_hook_that_hangs_keeps_nobody_waiting(tmp_path, caplog):
    fifo = tmp_path / "go"
    subprocess.run(["mkfifo", fifo], check=True)
    hooks = Hooks([HookTable(command=["sh", "-c", f"read line < {fifo}"], timeout_s=30.0)])
    hooks.tell(event())
    while not hooks._waiting.empty():
        time.sleep(0.01)
    for number in range(WAITING_MAX + 1):
        hooks.tell(event(number=number))
    assert "too slow" in caplog.text
    hooks._hooks = ()
    while not hooks._waiting.empty():
        hooks._waiting.get_nowait()
    fifo.write_text("go\n")
    hooks.close(WITHIN_S)


def test_log_lines_are_json_with_the_rig_and_the_event_and_plain_on_a_terminal():
    record = logging.LogRecord("estune.daemon", logging.WARNING, "", 0, "%s", ("drift\nb",), None)
    record.rig, record.event, record.facts = "drum", "drifted", {"cost": 1.5}
    line = JsonLines().format(record)
    assert "\n" not in line
    told = json.loads(line)
    assert (told["level"], told["message"], told["rig"]) == ("warning", "drift\nb", "drum")
    assert (told["event"], told["facts"]) == ("drifted", {"cost": 1.5})
    assert PlainLines().format(record).endswith("drum: warning: drift\nb")


# --- messages and records ---


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_what_is_no_command_is_refused(data):
    for kind in (Command, Request):
        try:
            message = decode_daemon(kind, data)
        except ProtocolError:
            continue
        assert decode_daemon(kind, encode_daemon(message)) == message


@pytest.mark.parametrize(
    "data",
    [
        b'{"command_id": "0123456789abcdef", "who": "me", "force": true}',
        b'{"command_id": "0123456789abcdeg", "who": "me"}',
        b'{"command_id": "0123456789abcdef", "who": ""}',
        b'{"command_id": "0123456789abcdef", "who": "' + b"x" * 3000 + b'"}',
    ],
)
def test_commands_are_checked(data):
    with pytest.raises(ProtocolError):
        decode_daemon(Command, data)


def test_a_repeated_command_is_carried_out_once(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        supervision, command = it.service._supervised["drum"], Command("ab" * 8, "me")
        first = supervision.command("pause", command)
        assert first.done
        it.say("resume")
        assert supervision.command("pause", command) == first
        assert it.until_mode("holding").paused == ""
        assert isinstance(first, CommandAnswer)


REQUEST = TrialRequest("run", 0, ORIGINAL, description().step)
FAULTS = [
    ({}, ""),
    ({"trial_id": "run-00007"}, "stale"),
    ({"rig": "other"}, "another rig"),
    ({"gains": replace(ORIGINAL, P=9.0)}, "was run with"),
    ({"sampling_Hz": 201.0}, "sampled at 201 Hz"),
    ({"started_at": "yesterday"}, "is none"),
    ({"started_at": "2009-05-04T12:00:00"}, "no offset"),
    ({"angle_rad": np.zeros(3)}, "differ in length"),
    ({"current_A": np.full(100, np.inf)}, "current_A is inf at sample 0"),
    ({"time_s": np.arange(100)[::-1] / 200.0}, "clock jumps"),
    ({"time_s": np.arange(100) / 200.0 + 9.0 * (np.arange(100) > 50)}, "at sample 51"),
]


@pytest.mark.parametrize(("changes", "words"), FAULTS)
def test_records_that_cannot_be_are_told_from_bad_trials(changes, words):
    record = replace(response(REQUEST), **changes)
    found = inspection.fault_of(record, REQUEST, description())
    assert words in found
    assert bool(found) is bool(words)


def test_a_trial_that_diverged_or_was_cut_short_is_no_fault():
    for record in (
        diverged(REQUEST),
        replace(diverged(REQUEST), outcome=Outcome.GUARD),
    ):
        assert inspection.fault_of(record, REQUEST, description()) == ""


def test_the_command_line_shows_and_commands(tmp_path, capsys):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        endpoint = it.service.endpoint

        def say(*words: str) -> str:
            assert run(["control", *words]) == 0
            return capsys.readouterr().out

        shown = say("status", endpoint)
        assert re.search(r"^live +original gains; home: original", shown, re.MULTILINE)
        assert re.search(r"^candidate is +better than the start: ", shown, re.MULTILINE)
        told = json.loads(say("status", endpoint, "--json"))
        assert told[0]["gains"]["original"]["P"] == ORIGINAL.P
        assert "accept by" in say("accept", endpoint, "--why", "looks good")
        assert "looks good" in say("history", endpoint)
        assert "better than the start" in say("events", endpoint)
        assert run(["control", "accept", endpoint]) == InvalidInput.exit_code
        assert "no candidate gains" in capsys.readouterr().err
        assert run(["control", "status", endpoint, "--rig", "other"]) == RigError.exit_code
        assert "there is: drum" in capsys.readouterr().err


# --- the store ---


def test_a_store_comes_back_as_it_was_left(tmp_path):
    candidate = replace(ORIGINAL, P=0.1 + 0.2)
    life = Life(Goal.HOLD, GainSet.ORIGINAL, "found so", paused="asked to")
    store = Store.open(tmp_path, "drum")
    with store.writing():
        store.set_gains(GainSet.ORIGINAL, ORIGINAL, "found")
        store.set_gains(GainSet.CANDIDATE, candidate, "better")
        store.life = life
        noted = store.note(Kind.BETTER, "better", {"cost": 0.5})
    record = response(REQUEST)
    store.ask_check(REQUEST)
    assert store.next_check() == (0, 0)
    store.tell_check(REQUEST, record, 1.5, Sign.STEADY)
    identity = store.identity
    store.close()
    store = Store.open(tmp_path, "drum")
    try:
        assert store.life == life
        assert store.gains() == {GainSet.ORIGINAL: ORIGINAL, GainSet.CANDIDATE: candidate}
        assert store.events(0, 9) == store.events(-1, 9) == [noted]
        assert store.identity == identity
        assert same(store.check_record(0), record)
        assert store.next_check() == (1, 0)
        with pytest.raises(JournalError, match="no record of check trial 1"):
            store.check_record(1)
    finally:
        store.close()


def test_a_store_of_the_first_version_is_gone_on_with(tmp_path):
    store = Store.open(tmp_path, "drum")
    life = Life(Goal.HOLD, GainSet.ACCEPTED, "better")
    with store.writing():
        store.put("life", asdict(life) | {"wanted": "candidate"})
        store._connection.execute("PRAGMA user_version=1")
    store.close()
    store = Store.open(tmp_path, "drum")
    assert store.life == life
    store.close()


def test_what_is_written_in_a_block_that_fails_is_not_there(tmp_path):
    store = Store.open(tmp_path, "drum")

    def half() -> None:
        with store.writing():
            store.set_gains(GainSet.ORIGINAL, ORIGINAL, "found")
            store.put("rig", object())

    with pytest.raises(TypeError):
        half()
    assert store.gains() == {}
    assert store.fact("rig") == "drum"
    store.close()


def test_a_store_does_not_grow_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.daemon.store.RECORDS_KEPT", 10)
    monkeypatch.setattr("estune.daemon.store.ROWS_KEPT", 20)
    store, record, sizes = Store.open(tmp_path, "drum"), response(REQUEST), []
    store._connection.execute("PRAGMA synchronous=OFF")
    for number in range(300):
        request = replace(REQUEST, number=number)
        store.ask_check(request)
        store.tell_check(request, record, 1.0, Sign.STEADY)
        store.note(Kind.SUSPECT, "far off", {})
        sizes.append(store._connection.execute("PRAGMA page_count").fetchone()[0])
    assert len(store.checks(100)) == len(store.events(0, 100)) == 20
    assert sizes[-1] == sizes[100]
    store.close()
