"""Metrics for Prometheus: in a file for the node exporter's collector, or over loopback HTTP."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from prometheus_client import CollectorRegistry, generate_latest, start_http_server
from prometheus_client.core import Metric as Family
from prometheus_client.registry import Collector

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


class MetricsServer:
    """Answers GET /metrics on a port of this machine's loopback interface."""

    def __init__(self, port: int, statuses: Callable[[], Iterable[DaemonStatus]]) -> None:
        """Listens; port 0 takes a free one.

        Raises:
            RigError: the port is taken.
        """
        try:
            self._server, _ = start_http_server(port, "127.0.0.1", _registry(statuses))
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
