"""The daemon's file, `daemon.toml`: which rigs, how they are tuned and watched, who is told."""

import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from estune.core.control_chart import ControlChart
from estune.daemon.events import EventKind
from estune.remote.zenoh.zenoh_session import check_endpoint, check_loopback
from estune.run.plan import DEFAULT_TUNER
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


class ServiceTable(TomlTable):
    """Where the daemon is asked for its status, and told what to do.

    Attributes:
        listen: Where it listens.
        routers: Zenoh routers to join as well.
        allow_remote: Whether to listen where other machines can reach it; without `security`,
            whoever reaches it can command it.
        security: File that says who may ask and command it; see docs/security.md.
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
    """Figures for Prometheus.

    Attributes:
        file: Written anew each time for the node exporter's textfile collector; its name should
            end in `.prom`.
        http_port: Served on this port of 127.0.0.1, under /metrics.
        every_s: How often the file is written.
    """

    file: Path | None = Field(default=None, strict=False)
    http_port: Annotated[int, Field(ge=0, le=65535)] | None = None
    every_s: Positive = 15.0


class HookTable(TomlTable):
    """A command that is run at events, with the event as JSON on its standard input.

    Attributes:
        command: The program and its arguments; no shell is involved.
        events: Which events; all if none is named.
        timeout_s: After this time it is killed.
    """

    command: Annotated[list[str], Field(min_length=1)]
    events: list[Annotated[EventKind, Field(strict=False)]] = Field(default=[])
    timeout_s: Positive = 10.0


class TuningTable(SearchTable):
    """How gains are looked for, and when they are good enough.

    Attributes:
        tuner: How gains are proposed.
        trials: Greatest number of search trials.
        repeats: Trials of the start before the search, and at the least of the start and of the
            gains found after it.
        tolerance: The search ends once no more than this share of the cost is left to gain; zero
            makes it use all its trials.
        eta_max: Cost above which a trial is unsafe; three times the start's if left out.
        confidence: Of the interval that the improvement must lie in.
        improvement_min: Fall of the cost, as a share, that the whole interval must exceed.
        bounds: Least and greatest value of gains, by name, in their own units.
    """

    tuner: TunerName = DEFAULT_TUNER
    repeats: Annotated[int, Field(ge=2)] = 5
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.95
    improvement_min: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0


class WatchTable(TomlTable):
    """How the accepted gains are watched.

    Attributes:
        every_s: Time between check trials.
        baseline_checks: So many checks come one after the other, to learn the scatter.
        smoothing: Weight of the newest check in the moving average.
        false_alarm_checks: Mean number of checks between false alarms.
        scatter_min: Scatter of the cost, as a share, that is always allowed for.
        rest_s: Least time from the end of a tuning to the next that a drift can start.
    """

    every_s: Positive = 3600.0
    baseline_checks: Count = 20
    smoothing: float = 0.2
    false_alarm_checks: float = 1000.0
    scatter_min: float = 0.01
    rest_s: NotNegative = 3600.0

    @property
    def chart(self) -> ControlChart:
        """The control chart."""
        return ControlChart(self.smoothing, self.false_alarm_checks, self.scatter_min)

    @model_validator(mode="after")
    def _chartable(self) -> Self:
        _ = self.chart
        return self


class RigTable(TomlTable):
    """One rig.

    Attributes:
        name: The rig's name on the link; names its folder too.
        target: Where it is: an endpoint, or a model as `estune tune` takes.
        accept: `auto` accepts gains that are better beyond doubt, `ask` waits for the verb.
        answer_within_s: How long the rig may take to answer.
        look_every_s: How often the rig is looked at while nothing is done with it.
        retry_first_s: Wait after a first failure; doubled with each that follows.
        retry_max_s: Longest wait.
        step: The step trial.
        cost: How it is scored.
        tuning: How gains are looked for.
        watch: How they are watched.
    """

    name: str
    target: str
    accept: Literal["auto", "ask"] = "auto"
    answer_within_s: Positive = 3.0
    look_every_s: Positive = 2.0
    retry_first_s: Positive = 1.0
    retry_max_s: Positive = 60.0
    step: StepTable = StepTable()
    cost: CostTable = CostTable()
    tuning: TuningTable = TuningTable()
    watch: WatchTable = WatchTable()

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
        state: Folder for everything that must not be lost, beside this file unless absolute.
        stop_within_s: How long a stop waits for a rig that does not answer.
        service: Where the daemon is spoken to.
        metrics: Figures for Prometheus.
        hook: Commands to be run at events.
        rig: The rigs.
    """

    state: Path = Field(default=Path("estune-state"), strict=False)
    stop_within_s: Positive = 30.0
    service: ServiceTable = ServiceTable()
    metrics: MetricsTable = MetricsTable()
    hook: list[HookTable] = Field(default=[])
    rig: Annotated[list[RigTable], Field(min_length=1)]

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        twice = [name for name, count in Counter(r.name for r in self.rig).items() if count > 1]
        if twice:
            raise ValueError(f"rig: {', '.join(twice)} is there more than once")
        return self


def read_config(path: Path) -> DaemonConfig:
    """Reads the daemon's file; its folders and files are looked for beside it.

    Raises:
        InvalidInput: it cannot be read, or something in it is wrong; all of it is in the message,
            a line each.
    """
    return config_from(read_toml(path), str(path), path.parent)


def config_from(data: dict[str, Any], source: str, beside: Path) -> DaemonConfig:
    """The configuration in data read from somewhere.

    Raises:
        InvalidInput: something in it is wrong; all of it is in the message, a line each.
    """
    config = validate(DaemonConfig, data, source)
    file, asks = config.metrics.file, config.service.security
    metrics = config.metrics.model_copy(update={"file": file and beside / file})
    service = config.service.model_copy(update={"security": asks and beside / asks})
    return config.model_copy(
        update={"state": beside / config.state, "metrics": metrics, "service": service}
    )


def plan_settings(rig: RigTable, description: RigDescription) -> dict[str, Any]:
    """What `estune.run.plan.make_plan` is told for a rig.

    Raises:
        InvalidInput: the step or the cost does not suit the rig.
    """
    tuning = rig.tuning
    step = rig.step.of(description)
    description.limits.check(step)
    return {
        "tuner": tuning.tuner,
        "bounds": dict(tuning.bounds) or None,
        "step": step,
        "cost": rig.cost.of(description),
        "trials": tuning.trials,
        "repeats": tuning.repeats,
        "eta_max": tuning.eta_max,
        "tolerance": tuning.tolerance,
    }
