"""Metrics for Prometheus: in a file for the node exporter's collector, or over loopback HTTP."""

import threading
from collections.abc import Callable, Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

from estune.core.gains import GAIN_NAMES
from estune.daemon.supervisor_state import GainSet, SupervisorMode
from estune.errors import RigError
from estune.remote.messages.daemon import DaemonStatus
from estune.support.whole_file import replace_file


class MetricSample(NamedTuple):
    """One value of a metric for one rig, with its labels beside the rig."""

    labels: dict[str, str]
    value: float


class Metric(NamedTuple):
    """A metric: its name, help, samples of a rig, and type."""

    name: str
    help: str
    samples: Callable[[DaemonStatus], Iterable[MetricSample]]
    kind: str = "gauge"


def _one(value: float | None) -> Iterator[MetricSample]:
    if value is not None:
        yield MetricSample({}, float(value))


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
        "1 for the current mode, 0 for the others.",
        lambda s: _states("mode", SupervisorMode, s.mode),
    ),
    Metric(
        "estune_gains_live",
        "1 for the gain set that the rig has confirmed to be live; none while it is away.",
        lambda s: _states("set", GainSet, s.live),
    ),
    Metric("estune_gain", "Controller gains of each set, in their own units.", _gains),
    Metric("estune_paused", "1 while the supervision is paused.", lambda s: _one(bool(s.paused))),
    Metric(
        "estune_failing",
        "1 while the rig is not reached or something fails.",
        lambda s: _one(bool(s.trouble)),
    ),
    Metric(
        "estune_run_trials",
        "Trials of the tuning run under way or the last one.",
        lambda s: _one(s.trials),
    ),
    Metric(
        "estune_cost_ratio",
        "Cost of the last trial; 1 is as good as first order.",
        lambda s: _one(s.cost),
    ),
    Metric(
        "estune_baseline_cost_ratio",
        "Baseline cost of the control chart.",
        lambda s: _one(s.baseline_cost),
    ),
    Metric(
        "estune_drift_ratio",
        "Deviation of the smoothed cost from its baseline, as a fraction of the alarm limit.",
        lambda s: _one(s.drift),
    ),
    Metric("estune_check_trials_total", "Check trials.", lambda s: _one(s.checks), "counter"),
)


def render(statuses: Iterable[DaemonStatus]) -> str:
    """The metrics of several rigs in Prometheus' text format."""
    statuses, lines = tuple(statuses), []
    for metric in METRICS:
        samples = [(s.rig, sample) for s in statuses for sample in metric.samples(s)]
        if samples:
            lines += [f"# HELP {metric.name} {metric.help}", f"# TYPE {metric.name} {metric.kind}"]
        for rig, sample in samples:
            labels = {"rig": rig, **sample.labels}
            inside = ",".join(f'{name}="{_escape(value)}"' for name, value in labels.items())
            lines.append(f"{metric.name}{{{inside}}} {sample.value!r}")
    return "\n".join([*lines, ""])


def write_metrics(path: Path, statuses: Iterable[DaemonStatus]) -> None:
    """Replaces a file by the metrics; readers always see a whole file.

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
            self._server = _Server(("127.0.0.1", port), _RequestHandler)
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
    daemon_threads = True
    statuses: Callable[[], Iterable[DaemonStatus]]


class _RequestHandler(BaseHTTPRequestHandler):
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
        """Logs nothing: a scrape is not an event."""


def _escape(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
