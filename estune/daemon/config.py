"""The daemon's file, `daemon.toml`: rigs, how they are tuned and watched, notifications."""

import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from estune.core.control_chart import ControlChart
from estune.daemon.events import EventKind
from estune.remote.messages.rights import Right
from estune.remote.zenoh.endpoints import check_endpoint, check_loopback
from estune.run.planning import suited_step
from estune.run.toml_tables import (
    CostTable,
    Count,
    NotNegative,
    Positive,
    SearchTable,
    StepTable,
    TunerName,
)
from estune.support.toml_file import TomlTable, read_toml, validate
from estune.trial import RigDescription
from estune.tuners import DEFAULT_TUNER


class ServiceTable(TomlTable):
    """Server for status requests and commands.

    Attributes:
        listen: Endpoint on which the daemon listens.
        routers: Zenoh routers to join as well.
        allow_remote: Allow an endpoint that other machines can reach; without `security`, every
            client on the network can command the daemon.
        security: File of the clients that may read and command; see docs/how-to/security.md.
    """

    listen: str = "tcp/127.0.0.1:7450"
    routers: list[str] = Field(default=[])
    allow_remote: bool = False
    security: Path | None = Field(default=None, strict=False)

    @model_validator(mode="after")
    def _endpoints(self) -> Self:
        for endpoint in (self.listen, *self.routers):
            check_endpoint(endpoint)
        if not self.allow_remote:
            check_loopback(self.listen)
        return self


class MetricsTable(TomlTable):
    """Metrics for Prometheus.

    Attributes:
        file: File for the node exporter's textfile collector, replaced each time; its name should
            end in `.prom`.
        http_port: Port of 127.0.0.1 that serves /metrics, /health and /ready.
        every_s: Time between two writes of the file.
    """

    file: Path | None = Field(default=None, strict=False)
    http_port: Annotated[int, Field(ge=0, le=65535)] | None = None
    every_s: Positive = 15.0


class PageTable(TomlTable):
    """The live page in the browser.

    Attributes:
        http_port: Port of 127.0.0.1 that serves the page; 0 takes a free one.
        allow_commands: Let the page command the daemon and stop the rigs, with a key that is part
            of the address printed at the start.
        allow_stop: Let the page stop the rigs alone, with such a key.
    """

    http_port: Annotated[int, Field(ge=0, le=65535)] | None = None
    allow_commands: bool = False
    allow_stop: bool = False

    @property
    def right(self) -> Right:
        """What a page with the key may do."""
        stop = Right.STOP if self.allow_stop else Right.LOOK
        return Right.COMMAND if self.allow_commands else stop


class HookTable(TomlTable):
    """A command that is run at events, with the event as JSON on its standard input.

    Attributes:
        command: Program and arguments; no shell is involved.
        events: Kinds of events; all if empty.
        timeout_s: Time after which the command is killed.
    """

    command: Annotated[list[str], Field(min_length=1)]
    events: list[Annotated[EventKind, Field(strict=False)]] = Field(default=[])
    timeout_s: Positive = 10.0


class TuningTable(SearchTable):
    """Settings of the search for gains, and of their acceptance.

    Attributes:
        tuner: Tuner that proposes gains.
        repeats: As in `Search`.
        confidence: Confidence level of the interval of the improvement.
        improvement_min: Relative decrease of the cost that the whole interval must exceed.
    """

    tuner: TunerName = DEFAULT_TUNER
    repeats: Annotated[int, Field(ge=2)] = 5
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.95
    improvement_min: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0


class WatchTable(TomlTable):
    """Settings of the monitoring of accepted gains.

    Attributes:
        every_s: Time between check trials.
        baseline_checks: Number of back-to-back check trials that estimate the baseline.
        smoothing: Weight of the newest check in the moving average.
        false_alarm_checks: Mean number of checks between false alarms.
        scatter_min: Lower bound of the relative standard deviation of the cost.
        rest_s: Least time from the end of a tuning to the next one that a drift starts.
        tracking: Beside each check, a step with the rest after it and a slow triangle.
    """

    every_s: Positive = 3600.0
    baseline_checks: Count = 20
    smoothing: float = 0.2
    false_alarm_checks: float = 1000.0
    scatter_min: float = 0.01
    rest_s: NotNegative = 3600.0
    tracking: bool = False

    @property
    def chart(self) -> ControlChart:
        """The control chart."""
        return ControlChart(self.smoothing, self.false_alarm_checks, self.scatter_min)

    @model_validator(mode="after")
    def _chartable(self) -> Self:
        _ = self.chart
        return self


class MarginsTable(TomlTable):
    """Settings of the monitoring of margins.

    Attributes:
        every_s: Least time between two statements of Ms.
        max_sensitivity: Ms that is reported once the whole of its interval is above it.
        dither: Multisine that is added to the setpoint for it, rms over the step; 0 is none.
        dither_time: Share of the time that it may take.
    """

    every_s: Positive = 60.0
    max_sensitivity: Annotated[float, Field(gt=1.0)] = 1.8
    dither: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    dither_time: Annotated[float, Field(gt=0.0, le=1.0)] = 0.2


class RigTable(TomlTable):
    """One rig.

    Attributes:
        name: The rig's name on the link, and of its folder.
        target: Endpoint of the rig, or a model as `estune tune` takes.
        accept: `auto` accepts a statistically significant improvement, `ask` waits for the verb.
        answer_within_s: Timeout of the rig's answers.
        look_every_s: Polling interval of an idle rig.
        retry_first_s: Wait after a first failure; doubled with each further one.
        retry_max_s: Longest wait.
        remedies: Patches with the proof of remedies that the rig's file has: one that has lost its
            gain is switched off.
    """

    name: str
    target: str
    accept: Literal["auto", "ask"] = "auto"
    answer_within_s: Positive = 3.0
    look_every_s: Positive = 2.0
    retry_first_s: Positive = 1.0
    retry_max_s: Positive = 60.0
    remedies: list[Annotated[Path, Field(strict=False)]] = Field(default=[])
    step: StepTable = StepTable()
    cost: CostTable = CostTable()
    tuning: TuningTable = TuningTable()
    watch: WatchTable = WatchTable()
    margins: MarginsTable = MarginsTable()

    def retry_s(self, failures: int) -> float:
        """Wait after so many consecutive failures."""
        # The exponent is bounded: a rig may be away for years.
        return min(self.retry_max_s, self.retry_first_s * 2.0 ** min(failures - 1, 30))

    @model_validator(mode="after")
    def _fits(self) -> Self:
        wrong = []
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", self.name):
            wrong.append(f"name: {self.name!r} may hold only 1 to 64 letters, digits, - and _")
        if not self.retry_first_s <= self.retry_max_s:
            wrong.append(
                f"retry_first_s: {self.retry_first_s:g} is above retry_max_s {self.retry_max_s:g}"
            )
        wrong += self.cost.too_long(self.step)
        if wrong:
            raise ValueError("\n".join(wrong))
        return self


class DaemonConfig(TomlTable):
    """The daemon's file.

    Attributes:
        state: Folder of the daemon's state, beside this file unless absolute.
        stop_within_s: Time that a stop waits for a rig that does not answer.
        shared: Other daemons have the same rigs in their files: a rig that one of them holds is
            left to it, and taken over when it leaves it.
        rigs_max: Most rigs that this daemon holds at once; all by default.
    """

    state: Path = Field(default=Path("estune-state"), strict=False)
    stop_within_s: Positive = 30.0
    shared: bool = False
    rigs_max: Count | None = None
    service: ServiceTable = ServiceTable()
    metrics: MetricsTable = MetricsTable()
    page: PageTable = PageTable()
    hook: list[HookTable] = Field(default=[])
    rig: Annotated[list[RigTable], Field(min_length=1)]

    def with_dither(self, share: float) -> "DaemonConfig":
        """The file with this multisine for all rigs.

        Raises:
            InvalidInput: the share is out of range.
        """
        tables = [
            validate(MarginsTable, {**rig.margins.model_dump(), "dither": share}, "--dither")
            for rig in self.rig
        ]
        rigs = [
            rig.model_copy(update={"margins": table})
            for rig, table in zip(self.rig, tables, strict=True)
        ]
        return self.model_copy(update={"rig": rigs})

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        twice = [name for name, count in Counter(r.name for r in self.rig).items() if count > 1]
        if twice:
            raise ValueError(f"rig: {', '.join(twice)} appears more than once")
        return self


def read_config(path: Path) -> DaemonConfig:
    """Reads the daemon's file; its paths are relative to its own folder.

    Raises:
        InvalidInput: it cannot be read, or has mistakes; the message has a line for each.
    """
    return config_from(read_toml(path), str(path), path.parent)


def config_from(data: dict[str, Any], source: str, beside: Path) -> DaemonConfig:
    """The configuration in data from a source.

    Raises:
        InvalidInput: it has mistakes; the message has a line for each.
    """
    config = validate(DaemonConfig, data, source)
    file, security = config.metrics.file, config.service.security
    metrics = config.metrics.model_copy(update={"file": file and beside / file})
    service = config.service.model_copy(update={"security": security and beside / security})
    rigs = [
        rig.model_copy(update={"remedies": [beside / path for path in rig.remedies]})
        for rig in config.rig
    ]
    paths = {"state": beside / config.state, "metrics": metrics, "service": service, "rig": rigs}
    return config.model_copy(update=paths)


def plan_settings(rig: RigTable, description: RigDescription) -> dict[str, Any]:
    """Arguments of `estune.run.plan.make_plan` for a rig.

    Raises:
        InvalidInput: the step or the cost does not suit the rig.
    """
    tuning, cost = rig.tuning, rig.cost.of(description)
    step = suited_step(rig.step.of(description), cost, description)
    description.limits.check(step)
    return {"tuner": tuning.tuner, "step": step, "cost": cost, **tuning.search}
