"""Figures for Prometheus: as a file for the node exporter's collector, or over loopback HTTP."""

import threading
from collections.abc import Callable, Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

from estune.core.gains import GAIN_NAMES
from estune.daemon.supervisor_state import GainSet, SupervisorMode
from estune.errors import RigError
from estune.remote.messages.daemon import DaemonStatus
from estune.run.export import replace_file


class MetricSample(NamedTuple):
    """One figure of one rig.

    Attributes:
        labels: What it is of, beside the rig.
        value: It.
    """

    labels: dict[str, str]
    value: float


class Metric(NamedTuple):
    """A metric: its name, type, help, and what it is for a rig."""

    name: str
    kind: str
    help: str
    of: Callable[[DaemonStatus], Iterable[MetricSample]]


def _one(value: float | None) -> Iterator[MetricSample]:
    if value is not None:
        yield MetricSample({}, value)


def _states(label: str, names: Iterable[str], actual: str) -> Iterator[MetricSample]:
    for name in names:
        yield MetricSample({label: name}, float(name == actual))


def _gains(status: DaemonStatus) -> Iterator[MetricSample]:
    for name, gains in sorted(status.gains.items()):
        for gain in GAIN_NAMES:
            yield MetricSample({"set": name, "gain": gain}, getattr(gains, gain))


METRICS = (
    Metric(
        "estune_mode",
        "gauge",
        "1 for what is done with the rig now.",
        lambda s: _states("mode", SupervisorMode, s.mode),
    ),
    Metric(
        "estune_gains_live",
        "gauge",
        "1 for the gain set that the rig has confirmed to be live; none while it is away.",
        lambda s: _states("set", GainSet, s.live),
    ),
    Metric("estune_gain", "gauge", "Controller gains of each set, in their own units.", _gains),
    Metric(
        "estune_paused",
        "gauge",
        "1 while nothing is done until somebody resumes.",
        lambda s: _one(float(bool(s.paused))),
    ),
    Metric(
        "estune_failing",
        "gauge",
        "1 while the rig is not reached or something fails.",
        lambda s: _one(float(bool(s.trouble))),
    ),
    Metric(
        "estune_run_trials",
        "gauge",
        "Trials told in the tuning run under way or the last one.",
        lambda s: _one(float(s.trials)),
    ),
    Metric(
        "estune_cost_ratio",
        "gauge",
        "Cost of the last trial; 1 is as good as first order.",
        lambda s: _one(s.cost),
    ),
    Metric(
        "estune_baseline_cost_ratio",
        "gauge",
        "Cost that check trials are held to.",
        lambda s: _one(s.baseline_cost),
    ),
    Metric(
        "estune_drift_ratio",
        "gauge",
        "Smoothed cost off its baseline, as a share of the control chart's limit.",
        lambda s: _one(s.drift),
    ),
    Metric(
        "estune_check_trials_total", "counter", "Check trials.", lambda s: _one(float(s.checks))
    ),
)


def render(statuses: Iterable[DaemonStatus]) -> str:
    """The metrics of several rigs in Prometheus' text format."""
    statuses, lines = tuple(statuses), []
    for metric in METRICS:
        figures = [(s.rig, figure) for s in statuses for figure in metric.of(s)]
        if figures:
            lines += [f"# HELP {metric.name} {metric.help}", f"# TYPE {metric.name} {metric.kind}"]
        for rig, figure in figures:
            labels = {"rig": rig, **figure.labels}
            inside = ",".join(f'{name}="{_quoted(value)}"' for name, value in labels.items())
            lines.append(f"{metric.name}{{{inside}}} {figure.value!r}")
    return "\n".join([*lines, ""])


def write_metrics(path: Path, statuses: Iterable[DaemonStatus]) -> None:
    """Writes the metrics into a file, which is there whole at any time.

    Raises:
        OSError: it cannot be written.
    """
    replace_file(path, render(statuses).encode())


class MetricsServer:
    """Answers GET /metrics on a port of this machine's loopback interface."""

    def __init__(self, port: int, statuses: Callable[[], Iterable[DaemonStatus]]) -> None:
        """Listens; port 0 takes a free one.

        Raises:
            RigError: the port is taken.
        """
        try:
            self._server = _Server(("127.0.0.1", port), _Answer)
        except OSError as error:
            raise RigError(
                f"cannot serve metrics on port {port} of 127.0.0.1: {error.strerror}; choose "
                "another http_port"
            ) from error
        self._server.statuses = statuses
        self.port = self._server.server_port
        threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True).start()

    def close(self) -> None:
        """Stops answering."""
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """The server, with what its answers are made of."""

    daemon_threads = True
    statuses: Callable[[], Iterable[DaemonStatus]]


class _Answer(BaseHTTPRequestHandler):
    """One request."""

    timeout = 5.0
    server: _Server

    def do_GET(self) -> None:
        if self.path != "/metrics":
            self.send_error(404)
            return
        text = render(self.server.statuses()).encode()
        self.send_response(200)
        self.send_header("Content-Type", "text/plain; version=0.0.4; charset=utf-8")
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def log_message(self, *_: object) -> None:
        """Says nothing: a scrape is no event."""


def _quoted(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
