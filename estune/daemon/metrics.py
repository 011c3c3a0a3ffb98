"""Metrics for Prometheus: in a file for the node exporter's collector, or over loopback HTTP."""

import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any, NamedTuple
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, generate_latest, make_wsgi_app
from prometheus_client.core import Metric as Family
from prometheus_client.registry import Collector

from estune.core.gains import GAIN_NAMES
from estune.daemon.supervisor_state import GainSet, SupervisorMode
from estune.errors import RigError
from estune.remote.messages.daemon import DaemonStatus
from estune.support.version import __version__
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


class _Rigs(Collector):
    """The metrics of several rigs as they are when they are asked for."""

    def __init__(self, statuses: Callable[[], Iterable[DaemonStatus]]) -> None:
        self._statuses = statuses

    def collect(self) -> Iterator[Family]:
        """The metrics that have a sample."""
        statuses = tuple(self._statuses())
        for metric in METRICS:
            family = Family(metric.name.removesuffix("_total"), metric.help, metric.kind)
            for status in statuses:
                for labels, value in metric.samples(status):
                    family.add_sample(metric.name, {"rig": status.rig, **labels}, value)
            if family.samples:
                yield family


def _registry(statuses: Callable[[], Iterable[DaemonStatus]]) -> CollectorRegistry:
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Rigs(statuses))
    return registry


def render(statuses: Iterable[DaemonStatus]) -> bytes:
    """The metrics of several rigs in Prometheus' text format."""
    return generate_latest(_registry(lambda: statuses))


def write_metrics(path: Path, statuses: Iterable[DaemonStatus]) -> None:
    """Replaces a file by the metrics; readers always see a whole file.

    Raises:
        OSError: it cannot be written.
    """
    replace_file(path, render(statuses))


class ThreadingServer(ThreadingMixIn, WSGIServer):
    """A server whose slow reader delays no other."""

    daemon_threads = True


class _Quiet(WSGIRequestHandler):
    """A handler that logs no requests."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the base's name
        pass


class DaemonHealth(NamedTuple):
    """State of the daemon itself.

    Attributes:
        stuck: Rigs whose supervision makes no progress.
        ready: Whether its supervisions have begun, and commands are taken.
        hook_failures: Commands of hooks that failed so far.
    """

    stuck: tuple[str, ...]
    ready: bool
    hook_failures: int


class _Daemon(Collector):
    """The metrics of the daemon itself."""

    def __init__(self, health: Callable[[], DaemonHealth]) -> None:
        self._health = health

    def collect(self) -> Iterator[Family]:
        """Version, stuck supervisions, failures of hooks."""
        health = self._health()
        info = Family("estune_build_info", "1, with the version as a label.", "gauge")
        info.add_sample("estune_build_info", {"version": __version__}, 1.0)
        yield info
        stuck = Family("estune_supervisions_stuck", "Supervisions without progress.", "gauge")
        stuck.add_sample("estune_supervisions_stuck", {}, float(len(health.stuck)))
        yield stuck
        hooks = Family("estune_hook_failures", "Commands of hooks that failed.", "counter")
        hooks.add_sample("estune_hook_failures_total", {}, float(health.hook_failures))
        yield hooks


class MetricsServer:
    """Answers GET /metrics, /health and /ready on a port of this machine's loopback interface.

    `/health` is 200 unless a supervision makes no progress, as the watchdog of systemd has it;
    `/ready` is 200 once commands are taken. Otherwise both are 503, with the reason.
    """

    def __init__(
        self,
        port: int,
        statuses: Callable[[], Iterable[DaemonStatus]],
        health: Callable[[], DaemonHealth],
    ) -> None:
        """Listens; port 0 takes a free one.

        Raises:
            RigError: the port is taken.
        """
        registry = _registry(statuses)
        registry.register(_Daemon(health))
        metrics = make_wsgi_app(registry)

        def answer(environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
            found = health()
            stuck = f"no progress with: {', '.join(found.stuck)}\n" if found.stuck else ""
            match environ.get("PATH_INFO"):
                case "/health":
                    fault = stuck
                case "/ready":
                    fault = "" if found.ready else "the supervisions have not begun\n"
                case _:
                    pages: Iterable[bytes] = metrics(environ, start)
                    return pages
            status = "503 Service Unavailable" if fault else "200 OK"
            start(status, [("Content-Type", "text/plain; charset=utf-8")])
            return [(fault or "ok\n").encode()]

        try:
            self._server = make_server(
                *("127.0.0.1", port, answer, ThreadingServer), handler_class=_Quiet
            )
            threading.Thread(
                target=self._server.serve_forever, name="metrics", daemon=True
            ).start()
        except OSError as error:
            raise RigError(
                f"cannot serve metrics on port {port} of 127.0.0.1: {error.strerror}; choose "
                "another http_port"
            ) from error
        self.port = self._server.server_port

    def close(self) -> None:
        """Stops answering."""
        self._server.shutdown()
        self._server.server_close()
