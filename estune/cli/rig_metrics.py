"""Metrics of a rig on hardware, for Prometheus."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from prometheus_client import CollectorRegistry
from prometheus_client.core import Metric as Family
from prometheus_client.registry import Collector

from estune.daemon.metrics import MetricsServer, build_info
from estune.hardware import HardwareRig
from estune.hardware.black_box import BlackBox
from estune.hardware.trial_board.rig import BoardRig
from estune.support.file_limits import parse_json

METRICS = {
    "estune_rig_build_info": "1, with the version as a label.",
    "estune_rig_commands_total": "Commands by verb and verdict of their reply.",
    "estune_rig_stops_total": "Stops that the black box has copied.",
    "estune_rig_samples_total": "Samples of the control loop.",
    "estune_rig_late_samples_total": "Late samples of them.",
    "estune_rig_missed_samples_total": "Sampling instants skipped altogether.",
    "estune_rig_bad_readings_total": "Bad readings of the driver.",
}
"""Metrics by name, with their help; those of samples where the loop runs on this machine."""


class RigMetrics(Collector):
    """The metrics of one rig, as they are when they are asked for."""

    def __init__(self, rig: HardwareRig | BoardRig, box: BlackBox | None) -> None:
        self._rig, self._box = rig, box
        self._commands: Counter[tuple[str, str]] = Counter()

    def hear(self, verb: str, payload: bytes, reply: bytes) -> None:
        """Counts a command, and passes it to the black box.

        A record's frame as reply is that of an accepted trial.
        """
        if self._box is not None:
            self._box.hear(verb, payload, reply)
        try:
            verdict = str(parse_json(reply).get("verdict", "accepted"))
        except ValueError:
            verdict = "accepted"
        self._commands[verb, verdict] += 1

    def fault(self) -> str:
        """Why the rig is not well; empty if it is."""
        try:
            self._rig.describe()
        except Exception as error:  # noqa: BLE001  whatever it is, it is the answer
            return str(error)
        return ""

    def collect(self) -> Iterator[Family]:
        """The metrics that apply."""
        yield build_info("estune_rig_build_info")
        commands = [
            ({"verb": verb, "verdict": verdict}, count)
            for (verb, verdict), count in sorted(self._commands.items())
        ]
        yield _counter("estune_rig_commands_total", commands)
        if self._box is not None:
            yield _counter("estune_rig_stops_total", [({}, self._box.stops)])
        if isinstance(self._rig, HardwareRig) and not self.fault():
            timing = self._rig.timing()
            yield _counter("estune_rig_samples_total", [({}, timing.samples)])
            yield _counter("estune_rig_late_samples_total", [({}, timing.late)])
            yield _counter("estune_rig_missed_samples_total", [({}, timing.missed)])
            yield _counter("estune_rig_bad_readings_total", [({}, timing.bad)])


def _counter(name: str, samples: list[tuple[dict[str, str], int]]) -> Family:
    family = Family(name.removesuffix("_total"), METRICS[name], "counter")
    for labels, count in samples:
        family.add_sample(name, labels, float(count))
    return family


@contextmanager
def rig_metrics(
    rig: HardwareRig | BoardRig, box: BlackBox | None, port: int | None
) -> Iterator[RigMetrics]:
    """The metrics of a rig, served as /metrics, /health and /ready on a loopback port if given.

    Raises:
        RigError: the port is taken.
    """
    metrics = RigMetrics(rig, box)
    if port is None:
        yield metrics
        return
    registry = CollectorRegistry(auto_describe=False)
    registry.register(metrics)
    server = MetricsServer(port, registry, {"/health": metrics.fault, "/ready": metrics.fault})
    try:
        yield metrics
    finally:
        server.close()
