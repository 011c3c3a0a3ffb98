"""Daemons in this process or another, with rigs that answer immediately."""

import json
import subprocess
import sys
import threading
import time
import tomllib
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from estune.core.gains import Gains
from estune.daemon.config import config_from
from estune.daemon.notifications import Notifier
from estune.daemon.service import DaemonService
from estune.remote import zenoh
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.remote.zenoh.endpoints import with_port
from estune.trial import TrialRecord, TrialRequest
from tests.support_rigs import ScriptedRig, description, response

ORIGINAL = description().gains
WITHIN_S = 120.0
"""Time limit, s, for events that take a second or two on an idle machine."""

RIG = """
[[rig]]
name = "{name}"
target = "{target}"
answer_within_s = 1.0
look_every_s = 0.1
retry_first_s = 0.1
retry_max_s = 0.3
accept = "{accept}"
tuning = {{trials = {trials}, repeats = 3}}
watch = {{every_s = {every_s}, baseline_checks = 12, rest_s = 0.0, smoothing = 0.3}}
"""


def rig_table(name: str, target: str, accept="ask", trials=12, every_s=0.05) -> str:
    return RIG.format(name=name, target=target, accept=accept, trials=trials, every_s=every_s)


class Plant:
    """Rig whose response can be made slower by `slower` while it runs."""

    def __init__(self) -> None:
        self.slower = 1.0

    def __call__(self, request: TrialRequest) -> TrialRecord:
        gains = replace(request.gains, P=request.gains.P / self.slower)
        return replace(response(replace(request, gains=gains)), gains=request.gains)


@contextmanager
def rig_served(name: str = "drum", plant=None, **changes):
    """Scripted rig over Zenoh, and its endpoint."""
    rig = ScriptedRig(plant or Plant(), name=name, **changes)
    with zenoh.serve(rig) as server:
        yield rig, server.endpoint


@contextmanager
def daemon(
    folder: Path,
    *rigs: str,
    more: str = "",
    top: str = "",
    notifier: Notifier | None = None,
    security: Security = OPEN,
    client: Security = OPEN,
):
    """A daemon in this process, and a client of it."""
    service_table = f'[service]\nlisten = "tcp/127.0.0.1:0"\n{more}'
    text = f"stop_within_s = 3.0\n{top}\n{service_table}\n{''.join(rigs)}"
    config = config_from(tomllib.loads(text), "test", folder)
    service = DaemonService(config, notifier, security=security)
    failed = []

    def run():
        try:
            service.run()
        except Exception as error:  # noqa: BLE001  handed over to the test
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        with DaemonClient(service.endpoint, security=client) as asking:
            yield Watched(service, asking, thread, failed)
    finally:
        service.stop()
        thread.join(WITHIN_S)
        assert not thread.is_alive()


class Watched:
    """A daemon and its client."""

    def __init__(self, service, client, thread=None, failed=()) -> None:
        self.service, self.client, self.thread, self.failed = service, client, thread, failed

    def until(self, condition, rig: str = "drum"):
        """First status that meets the condition."""
        ends = time.monotonic() + WITHIN_S
        while not condition(status := self.client.status(rig)):
            assert time.monotonic() < ends, status
            time.sleep(0.01)
        return status

    def until_mode(self, mode: str, rig: str = "drum"):
        return self.until(lambda status: status.mode == mode, rig)

    def command(self, verb: str, rig: str = "drum") -> str:
        return self.client.command(rig, verb, "the test")

    def kinds(self, rig: str = "drum") -> list[str]:
        return [event.kind for event in self.client.events(rig, limit=1000)]


@contextmanager
def daemon_process(folder: Path, *rigs: str, env=None):
    """A daemon in another process, from its file; killed at the end."""
    file = folder / "daemon.toml"
    endpoint = with_port("tcp/127.0.0.1:0")
    file.write_text(
        f'stop_within_s = 3.0\n[service]\nlisten = "{endpoint}"\n{"".join(rigs)}', encoding="utf-8"
    )
    with (folder / "log").open("a") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "estune", "daemon", str(file)],
            cwd=Path(__file__).parents[1],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=env,
        )
    try:
        assert process.stdout.readline().startswith("daemon at"), (folder / "log").read_text()
        with DaemonClient(endpoint) as client:
            yield process, Watched(None, client)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def log_lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "log").read_text().splitlines()]


def live_gains(endpoint: str) -> Gains:
    with zenoh.connect(endpoint) as rig:
        return rig.describe().gains
