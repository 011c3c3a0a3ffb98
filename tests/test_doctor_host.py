"""Checks of times, clock, permissions and ports, and the command itself."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from estune.cli.checks import State
from estune.cli.checks.driver_checks import check_loop
from estune.cli.checks.host_checks import (
    Host,
    check_ledger,
    check_permissions,
    check_ports,
    find_host,
)
from estune.cli.checks.link_checks import Dated, check_clock, check_link
from estune.hardware.shared_memory import BINS, Timing
from estune.trial import Outcome
from tests.serve_rig import served, small_board

ROOT = Path(__file__).parents[1]


LOCAL = "tcp/127.0.0.1:7447"


ELSEWHERE = "tcp/192.0.2.1:7447"  # an address for documentation: no process of this machine


def test_loop_that_commands_late_fails():
    def judged(turnaround_us):
        counts = np.zeros(BINS, np.int64)
        counts[turnaround_us // 2] = 1000
        return check_loop(Timing(1000, 0, 0, 0, counts, counts), 632.0)

    assert judged(400).state is State.FINE
    assert judged(900).state is State.FIX


def test_link_too_slow_for_the_lease_fails():
    assert check_link([0.001] * 200).state is State.FINE
    assert check_link([0.001] * 190 + [0.4] * 10).state is State.FIX


NOW_S = 1_700_000_000.0


def at(offset_s: float, after_s: float, before_s: float = 0.0, within_s: float = 0.0) -> Dated:
    """A trial that took a second, on a rig whose clock is off; ours steps before or in it."""
    asked_s = NOW_S + after_s + before_s
    start = datetime.fromtimestamp(asked_s + offset_s, UTC) + timedelta(seconds=0.1)
    return Dated(asked_s, asked_s + 1.0 + within_s, after_s + 1.0, start.isoformat())


def test_clock_that_is_off_or_jumps_fails():
    steady = [at(0.2, 2.0 * n) for n in range(5)]
    assert check_clock(steady).state is State.FINE
    ahead = check_clock([at(30.0, 2.0 * n) for n in range(5)])
    assert ahead.state is State.FIX
    assert ahead.figures["clock_offset_low_s"] < 30.1 < ahead.figures["clock_offset_high_s"] + 0.2
    jumped = check_clock([*steady, at(-5.0, 20.0)])
    assert jumped.state is State.FIX
    assert "jumped" in jumped.sentence
    for jump in ({"within_s": 3600.0}, {"before_s": -7.0}):
        own = check_clock([*steady, at(0.2, 20.0, **jump)])
        assert "this machine's clock jumped" in own.sentence


HOST = Host(1, ("127.0.0.1:7447",), real_time=True, locked=True, ledger=Path("rig.ledger"))


@pytest.mark.parametrize(
    ("host", "software", "simulated", "state"),
    [
        (HOST, "estune 1.0", False, State.FINE),
        (replace(HOST, real_time=False), "estune 1.0", False, State.FIX),
        (replace(HOST, locked=False), "estune 1.0", False, State.FIX),
        (None, "estune 1.0", False, State.UNKNOWN),
        (replace(HOST, real_time=False), "estune 1.0", True, State.FINE),
        # A gateway to a board, and a router to estune's own rig.
        (replace(HOST, real_time=False), "gateway 2", False, State.UNKNOWN),
        (replace(HOST, locked=False, ledger=None), "estune 1.0", False, State.UNKNOWN),
    ],
)
def test_missing_permissions_fail_only_where_the_loop_runs(host, software, simulated, state):
    result = check_permissions(host, simulated=simulated, software=software)
    assert result.state is state
    assert (state is State.UNKNOWN) == result.sentence.startswith("not stated")


@pytest.mark.parametrize(
    ("host", "endpoint", "authenticated", "state"),
    [
        (HOST, "tcp/127.0.0.1:7447", False, State.FINE),
        (replace(HOST, listens=("0.0.0.0:7447",)), "tcp/127.0.0.1:7447", False, State.FIX),
        (replace(HOST, listens=("[::]:7447",)), "tcp/127.0.0.1:7447", True, State.FINE),
        (replace(HOST, listens=("[::1]:7447",)), "tcp/[::1]:7447", False, State.FINE),
        # Another port of the process, of which the rig states nothing.
        (replace(HOST, listens=("127.0.0.1:7447", "0.0.0.0:80")), LOCAL, False, State.FINE),
        (None, ELSEWHERE, False, State.FIX),
        (None, ELSEWHERE, True, State.FINE),
        (None, "tcp/localhost:7447", False, State.FINE),
    ],
)
def test_open_port_without_authentication_fails(host, endpoint, authenticated, state):
    assert check_ports(host, endpoint, authenticated=authenticated).state is state


def test_ledger_is_reported_where_visible_and_else_not_stated():
    assert "rig.ledger" in check_ledger(HOST, simulated=False).sentence
    for host in (replace(HOST, ledger=None), None):
        for simulated, state in ((True, State.FINE), (False, State.UNKNOWN)):
            result = check_ledger(host, simulated=simulated)
            assert result.state is state
            assert result.sentence.startswith("not stated")


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="only Linux tells")
def test_listening_process_is_found_with_its_addresses():
    with socket.create_server(("127.0.0.1", 0)) as one:
        with socket.create_server(("0.0.0.0", 0)) as other:  # noqa: S104  what is looked for
            ports = one.getsockname()[1], other.getsockname()[1]
            host = find_host(f"tcp/127.0.0.1:{ports[0]}")
        assert host.pid == os.getpid()
        assert {f"127.0.0.1:{ports[0]}", f"0.0.0.0:{ports[1]}"} <= set(host.listens)
    assert find_host(f"tcp/127.0.0.1:{ports[1]}") is None
    assert find_host(ELSEWHERE) is None


def call(*arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "estune", "doctor", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_doctor_command_fails_with_failed_checks_in_json():
    with served("simulated") as server:
        done = call(server.endpoint, "--move", "--json")
        assert done.returncode == 0, done.stderr
        findings = {f["check"]: f for f in json.loads(done.stdout)["findings"]}
        assert findings["cost"]["state"] == "fine"
        assert findings["ledger"]["sentence"].startswith("on disk")
        done = call(server.endpoint)
        assert done.returncode == 0
        assert "nothing may move" in done.stdout
    with served("diverging") as server:
        done = call(server.endpoint, "--move")
        assert done.returncode == 4
        assert "failed checks: " in done.stderr
        assert "-> " in done.stdout
        assert Outcome.DIVERGED.sentence in done.stdout


@pytest.mark.slow
def test_doctor_command_finds_no_fault_in_what_a_board_does_not_state(tmp_path):
    with small_board(tmp_path) as (_, endpoint):
        done = call(endpoint, "--json")
    assert done.returncode == 0, done.stdout
    findings = {f["check"]: f for f in json.loads(done.stdout)["findings"]}
    assert findings["ledger"]["sentence"].startswith("not stated")
