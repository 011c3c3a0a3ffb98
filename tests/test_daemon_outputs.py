"""Outputs of the daemon: metrics, hooks, log lines."""

import http.client
import json
import logging
import re
import subprocess
import threading
import time
from dataclasses import replace

import pytest
from prometheus_client import generate_latest

import estune
from estune.daemon.config import HookTable
from estune.daemon.events import EventKind
from estune.daemon.faults import FaultCode
from estune.daemon.metrics import (
    DaemonHealth,
    MetricsServer,
    RigFigures,
    daemon_registry,
    write_metrics,
)
from estune.daemon.notifications import QUEUE_MAX, Hooks
from estune.daemon.supervised_rig import RigCounts
from estune.remote.messages.daemon import (
    DaemonEvent,
    DaemonStatus,
)
from estune.support.log_lines import JsonLines, PlainLines
from estune.trial import Outcome
from tests.support_daemon import ORIGINAL, WITHIN_S, daemon, rig_served, rig_table


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


def parse_metrics(text: str) -> dict[tuple[str, frozenset], float]:
    """Samples of a text in Prometheus' format, parsed strictly."""
    samples = {}
    for line in text.removesuffix("\n").split("\n"):
        if line.startswith("#"):
            assert re.fullmatch(r"# (HELP [a-z_]+ .+|TYPE [a-z_]+ (gauge|counter))", line)
            continue
        match = re.fullmatch(r"([a-z_]+)(?:\{(.*)\})? (\S+)", line)
        labels = re.findall(r'([a-z]+)="((?:[^"\\\n]|\\.)*)"', match[2] or "")
        key = match[1], frozenset(labels)
        assert key not in samples
        samples[key] = float(match[3])
    return samples


WELL = DaemonHealth((), ready=True, hook_failures=0)


def registry(*statuses, counts=None):
    rigs = [RigFigures(s, counts or RigCounts()) for s in statuses or (status(),)]
    return daemon_registry(lambda: rigs, lambda: WELL)


def rendered(*statuses, counts=None) -> dict:
    return parse_metrics(generate_latest(registry(*statuses, counts=counts)).decode())


def test_metrics_are_prometheus_text_of_the_status_and_the_counts():
    counts = RigCounts(leases_lost=2, commands_refused=3)
    for outcome in (Outcome.DONE, Outcome.DONE, Outcome.GUARD):
        counts.note_trial(outcome, 1.5)
    counts.faults[FaultCode.RIG_LOST.value] += 4
    paused = status(rig='o"d\\d', mode="paused", live="")
    samples = rendered(status(), paused, counts=counts)

    def figure(name, rig="drum", **labels):
        return samples[name, frozenset({"rig": rig, **labels}.items())]

    assert figure("estune_mode", mode="watching") == 1.0
    assert figure("estune_mode", mode="paused") == 0.0
    assert figure("estune_gains_live", set="accepted") == 1.0
    assert figure("estune_gain", set="original", gain="P") == ORIGINAL.P
    assert figure("estune_drift_ratio") == -0.5
    assert figure("estune_trials_total", outcome="done") == 2.0
    assert figure("estune_trial_seconds_total") == 4.5
    assert figure("estune_leases_lost_total") == 2.0
    assert figure("estune_commands_refused_total") == 3.0
    assert figure("estune_faults_total", fault="rig-lost") == 4.0
    assert ("estune_cost_ratio", frozenset({("rig", "drum")})) not in samples
    odd = r"o\"d\\d"
    assert all(figure("estune_gains_live", odd, set=s) == 0.0 for s in ("original", "candidate"))


def test_metrics_file_is_whole_at_every_read(tmp_path):
    file, sizes, over = tmp_path / "estune.prom", set(), threading.Event()
    write_metrics(file, registry())

    def read():
        while not over.is_set():
            sizes.add(len(parse_metrics(file.read_text())))

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(200):
        write_metrics(file, registry())
    over.set()
    reader.join()
    assert sizes == {len(rendered())}
    assert [path.name for path in tmp_path.iterdir()] == ["estune.prom"]


def test_health_and_readiness_are_told_with_the_reason():
    health = [DaemonHealth((), ready=False, hook_failures=0)]
    asked = {"/health": lambda: health[0].fault, "/ready": lambda: health[0].obstacle}
    figures = [RigFigures(status(), RigCounts())]
    server = MetricsServer(0, daemon_registry(lambda: figures, lambda: health[0]), asked)

    def get(path):
        connection = http.client.HTTPConnection("127.0.0.1", server.port)
        connection.request("GET", path)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, text

    assert get("/health") == (200, "ok\n")
    assert get("/ready")[0] == 503
    health[0] = DaemonHealth(("drum",), ready=False, hook_failures=3)
    assert get("/health") == (503, "no progress with: drum\n")
    code, text = get("/metrics")
    samples = parse_metrics(text)
    assert (code, samples["estune_hook_failures_total", frozenset()]) == (200, 3.0)
    assert samples["estune_supervisions_stuck", frozenset()] == 1.0
    assert samples["estune_build_info", frozenset({("version", estune.__version__)})] == 1.0
    health[0] = DaemonHealth((), ready=True, hook_failures=3)
    assert get("/ready") == (200, "ok\n")
    server.close()


def test_metrics_are_in_the_file_and_on_loopback(tmp_path):
    more = '[metrics]\nfile = "estune.prom"\nevery_s = 0.05\nhttp_port = 0'
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where), more=more) as it:
        it.until_mode("holding")
        live = "estune_gains_live", frozenset({"rig": "drum", "set": "original"}.items())
        connection = http.client.HTTPConnection("127.0.0.1", it.service.metrics_port)
        connection.request("GET", "/metrics")
        answer = connection.getresponse()
        assert answer.status == 200
        assert parse_metrics(answer.read().decode())[live] == 1.0
        connection.close()
        while parse_metrics((tmp_path / "estune.prom").read_text()).get(live) != 1.0:
            time.sleep(0.01)


def event(kind=EventKind.DRIFTED, number=1) -> DaemonEvent:
    return DaemonEvent(
        "drum", number, "2009-05-04T12:00:00+02:00", kind, "the cost", {"cost": 1.5}
    )


def test_hooks_get_their_kinds_of_events_as_json(tmp_path):
    out = tmp_path / "out"
    hook = HookTable(
        command=["sh", "-c", f"cat >> {out}; echo >> {out}"],
        events=[EventKind.DRIFTED, EventKind.LOST],
    )
    hooks = Hooks([hook])
    for kind in (EventKind.DRIFTED, EventKind.GAINS, EventKind.LOST):
        hooks.submit(event(kind))
    hooks.close(WITHIN_S)
    events = [json.loads(line) for line in out.read_text().splitlines()]
    assert [line["kind"] for line in events] == ["drifted", "lost"]
    assert events[0] == {
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
def test_failing_hooks_are_logged(command, words, caplog):
    hooks = Hooks([HookTable(command=command, timeout_s=0.05 if "sleep" in command[-1] else 10.0)])
    hooks.submit(event())
    hooks.close(WITHIN_S)
    assert words in caplog.text
    assert bool(caplog.text) is bool(words)


def test_hanging_hook_drops_events_when_the_queue_is_full(tmp_path, caplog):
    fifo = tmp_path / "go"
    subprocess.run(["mkfifo", fifo], check=True)
    hooks = Hooks([HookTable(command=["sh", "-c", f"read line < {fifo}"], timeout_s=30.0)])
    hooks.submit(event())
    while not hooks._waiting.empty():
        time.sleep(0.01)
    for number in range(QUEUE_MAX + 1):
        hooks.submit(event(number=number))
    assert "too slow" in caplog.text
    hooks._hooks = ()
    while not hooks._waiting.empty():
        hooks._waiting.get_nowait()
    fifo.write_text("go\n")
    hooks.close(WITHIN_S)


def test_log_lines_are_json_or_plain_with_rig_and_event():
    record = logging.LogRecord("estune.daemon", logging.WARNING, "", 0, "%s", ("drift\nb",), None)
    record.rig, record.event, record.facts = "drum", "drifted", {"cost": 1.5}
    line = JsonLines().format(record)
    assert "\n" not in line
    entry = json.loads(line)
    assert (entry["level"], entry["message"], entry["rig"]) == ("warning", "drift\nb", "drum")
    assert (entry["event"], entry["facts"]) == ("drifted", {"cost": 1.5})
    assert PlainLines().format(record).endswith(" warning: drum: drift\nb")
