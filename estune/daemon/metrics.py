"""Metrics for Prometheus: in a file for the node exporter's collector, or over loopback HTTP."""

import math
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any, NamedTuple
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, generate_latest, make_wsgi_app
from prometheus_client.core import Metric as Family
from prometheus_client.registry import Collector

from estune.core.gains import GAIN_NAMES
from estune.daemon.supervised_rig import RigCounts
from estune.daemon.supervisor_state import GainSet, SupervisorMode
from estune.errors import RigError
from estune.remote.messages.daemon import DaemonStatus
from estune.support.version import __version__
from estune.support.whole_file import replace_file


class MetricSample(NamedTuple):
    """One value of a metric for one rig, with its labels beside the rig."""

    labels: dict[str, str]
    value: float


class RigFigures(NamedTuple):
    """What the metrics of one rig are made from."""

    status: DaemonStatus
    counts: RigCounts


class Metric(NamedTuple):
    """A metric: its name, help, samples of a rig, and type."""

    name: str
    help: str
    samples: Callable[[RigFigures], Iterable[MetricSample]]
    kind: str = "gauge"


def _one(value: float | None) -> Iterator[MetricSample]:
    if value is not None:
        yield MetricSample({}, float(value))


def _states(label: str, names: Iterable[str], actual: str) -> Iterator[MetricSample]:
    for name in names:
        yield MetricSample({label: name}, float(name == actual))


def _by(label: str, counts: Counter[str]) -> Iterator[MetricSample]:
    for name, count in sorted(counts.items()):
        yield MetricSample({label: name}, float(count))


def _gains(rig: RigFigures) -> Iterator[MetricSample]:
    for name, gains in sorted(rig.status.gains.items()):
        for gain in GAIN_NAMES:
            yield MetricSample({"set": name, "gain": gain}, getattr(gains, gain))


def _named(
    names: Sequence[str], label: str, values: Sequence[float | None] | None
) -> Iterator[MetricSample]:
    for name, value in zip(names, values or (), strict=False):
        yield MetricSample({label: name}, math.inf if value is None else value)


METRICS = (
    Metric(
        "estune_mode",
        "1 for the current mode, 0 for the others.",
        lambda r: _states("mode", SupervisorMode, r.status.mode),
    ),
    Metric(
        "estune_gains_live",
        "1 for the gain set that the rig has confirmed to be live; none while it is away.",
        lambda r: _states("set", GainSet, r.status.live),
    ),
    Metric("estune_gain", "Controller gains of each set, in their own units.", _gains),
    Metric(
        "estune_paused",
        "1 while the supervision is paused.",
        lambda r: _one(bool(r.status.paused)),
    ),
    Metric(
        "estune_failing",
        "1 while the rig is not reached or something fails.",
        lambda r: _one(bool(r.status.trouble)),
    ),
    Metric(
        "estune_run_trials",
        "Trials of the tuning run under way or the last one.",
        lambda r: _one(r.status.trials),
    ),
    Metric(
        "estune_cost_ratio",
        "Cost of the last trial; 1 is as good as first order.",
        lambda r: _one(r.status.cost),
    ),
    Metric(
        "estune_baseline_cost_ratio",
        "Baseline cost of the control chart.",
        lambda r: _one(r.status.baseline_cost),
    ),
    Metric(
        "estune_drift_ratio",
        "Deviation of the smoothed cost from its baseline, as a fraction of the alarm limit.",
        lambda r: _one(r.status.drift),
    ),
    Metric(
        "estune_check_trials_total", "Check trials.", lambda r: _one(r.status.checks), "counter"
    ),
    Metric(
        "estune_trials_total",
        "Trials by outcome since the daemon was started.",
        lambda r: _by("outcome", r.counts.trials),
        "counter",
    ),
    Metric(
        "estune_trial_seconds_total",
        "Time of these trials together, from the request to the record.",
        lambda r: _one(r.counts.trial_s),
        "counter",
    ),
    Metric(
        "estune_leases_lost_total",
        "Leases that ended during a trial.",
        lambda r: _one(r.counts.leases_lost),
        "counter",
    ),
    Metric(
        "estune_commands_refused_total",
        "Commands of operators that the mode did not allow.",
        lambda r: _one(r.counts.commands_refused),
        "counter",
    ),
    Metric(
        "estune_faults_total",
        "Faults by code.",
        lambda r: _by("fault", r.counts.faults),
        "counter",
    ),
    Metric(
        "estune_sensitivity",
        "Ms of the live gains, and the ends of its 95 % interval, while it is known.",
        lambda r: _named(("estimate", "low", "high"), "end", r.status.sensitivity),
    ),
    Metric(
        "estune_behaviour",
        "Error on a slow triangle, at its reversals, and deviation at rest, once measured.",
        lambda r: _named(("tracking", "reversal", "rest"), "measure", r.status.behaviour),
    ),
)


class _Rigs(Collector):
    def __init__(self, rigs: Callable[[], Iterable[RigFigures]]) -> None:
        self._rigs = rigs

    def collect(self) -> Iterator[Family]:
        rigs = tuple(self._rigs())
        for metric in METRICS:
            family = Family(metric.name.removesuffix("_total"), metric.help, metric.kind)
            for rig in rigs:
                for labels, value in metric.samples(rig):
                    family.add_sample(metric.name, {"rig": rig.status.rig, **labels}, value)
            if family.samples:
                yield family


def write_metrics(path: Path, registry: CollectorRegistry) -> None:
    """Replaces a file by the metrics; readers always see a whole file.

    Raises:
        OSError: it cannot be written.
    """
    replace_file(path, generate_latest(registry))


class ThreadingServer(ThreadingMixIn, WSGIServer):
    """A server whose slow reader delays no other."""

    daemon_threads = True


class _Quiet(WSGIRequestHandler):
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

    @property
    def fault(self) -> str:
        """Why it is not well, as the watchdog of systemd has it; empty if it is."""
        return f"no progress with: {', '.join(self.stuck)}" if self.stuck else ""

    @property
    def obstacle(self) -> str:
        """Why it takes no commands; empty if it does."""
        return "" if self.ready else "no supervisor has started"


def build_info(metric: str) -> Family:
    """The metric of this name that tells the version."""
    info = Family(metric, "1, with the version as a label.", "gauge")
    info.add_sample(metric, {"version": __version__}, 1.0)
    return info


class _Daemon(Collector):
    def __init__(self, health: Callable[[], DaemonHealth]) -> None:
        self._health = health

    def collect(self) -> Iterator[Family]:
        health = self._health()
        yield build_info("estune_build_info")
        stuck = Family("estune_supervisions_stuck", "Supervisions without progress.", "gauge")
        stuck.add_sample("estune_supervisions_stuck", {}, float(len(health.stuck)))
        yield stuck
        hooks = Family("estune_hook_failures", "Commands of hooks that failed.", "counter")
        hooks.add_sample("estune_hook_failures_total", {}, float(health.hook_failures))
        yield hooks


def daemon_registry(
    rigs: Callable[[], Iterable[RigFigures]], health: Callable[[], DaemonHealth]
) -> CollectorRegistry:
    """The metrics of a daemon and of its rigs, as they are when they are asked for."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Rigs(rigs))
    registry.register(_Daemon(health))
    return registry


class MetricsServer:
    """Answers GET /metrics, /health and /ready on a port of this machine's loopback interface.

    `/health` and `/ready` are 200, or 503 with the reason.
    """

    def __init__(
        self, port: int, registry: CollectorRegistry, faults: Mapping[str, Callable[[], str]]
    ) -> None:
        """Listens; port 0 takes a free one.

        Raises:
            RigError: the port is taken.
        """
        metrics = make_wsgi_app(registry)

        def answer(environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
            asked = faults.get(environ.get("PATH_INFO", ""))
            if asked is None:
                pages: Iterable[bytes] = metrics(environ, start)
                return pages
            fault = asked()
            status = "503 Service Unavailable" if fault else "200 OK"
            start(status, [("Content-Type", "text/plain; charset=utf-8")])
            return [f"{fault or 'ok'}\n".encode()]

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
