"""Notifications to systemd, and the unit file."""

import select
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from estune.daemon.notifications import Notifier
from estune.daemon.progress_watch import ProgressWatch
from tests.support_daemon import WITHIN_S, daemon, rig_served, rig_table

ROOT = Path(__file__).parents[1]


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
    manager = Manager(str(tmp_path / "notify"))
    yield manager
    manager.socket.close()


def test_notifier_reports_start_state_watchdog_and_stop(tmp_path, manager):
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


def test_stuck_supervisor_stops_feeding_the_watchdog(tmp_path, manager, monkeypatch):
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "60000"}
    with rig_served() as (_, where):
        notifier = Notifier(environment)
        with daemon(tmp_path, rig_table("drum", where), notifier=notifier) as it:
            it.until_mode("holding")
            manager.until("WATCHDOG", "1")
            supervisor = it.service._supervisors[0]
            assert not supervisor.is_stuck
            monkeypatch.setattr(ProgressWatch, "mark", lambda *_: None)
            supervisor._progress._idle_until_s -= 1e4
            assert supervisor.is_stuck
            time.sleep(0.6)  # what was on its way
            while select.select([manager.socket], [], [], 0.0)[0]:
                manager.socket.recv(65536)
            assert not select.select([manager.socket], [], [], 0.6)[0]


def test_notifier_ignores_missing_socket_and_foreign_watchdog():
    Notifier({}).notify(READY=1)
    assert Notifier({}).watchdog_s is None
    assert Notifier({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "1"}).watchdog_s is None
    assert Notifier({"WATCHDOG_USEC": "5000000"}).watchdog_s == 5.0


def test_notifier_reaches_abstract_socket_and_escapes_line_breaks():
    name = f"estune-test-{id(object())}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(f"\0{name}")
        Notifier({"NOTIFY_SOCKET": f"@{name}"}).notify(STATUS="one\nREADY=1")
        assert receiver.recv(100) == b"STATUS=one READY=1"


def test_unit_file_is_accepted_by_systemd(tmp_path):
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
