"""Design of a sweep: its file, `sweep.toml`, or the same keys from Python."""

from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from estune.core.gains import GAIN_NAMES
from estune.run import targets
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


class SweptRig(TomlTable):
    """A model, instantiated at every length, or a rig at an endpoint, which stands at one.

    Attributes:
        target: A model (`plants:reference_reel`, `reel.toml`) or an endpoint
            (`tcp/127.0.0.1:7447`).
        name: Label in the sweep; by default the target.
        rig: Name of the rig, where several answer at the endpoint.
        cable_length_m: Cable length of a rig whose description does not state it, m.
        security: Credentials file, if the rig requires authentication.
        patience_s: How long to wait for the rig to appear, and where it stops
            replying, s; 3 s and 30 s by default.
    """

    target: str
    name: str = ""
    rig: str | None = None
    cable_length_m: Positive | None = None
    security: Path | None = Field(default=None, strict=False)
    patience_s: Positive | None = None

    @property
    def label(self) -> str:
        """Name in tables and messages."""
        return self.name or (self.target if self.rig is None else f"{self.rig}@{self.target}")

    @property
    def is_model(self) -> bool:
        """Whether it is a simulation model, not an endpoint."""
        return not targets.is_endpoint(self.target)

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = ("rig", "cable_length_m", "security", "patience_s")
        given = {name: getattr(self, name) for name in names}
        wrong = [key for key, value in given.items() if value is not None and self.is_model]
        if wrong:
            raise ValueError(
                f"{wrong[0]}: {self.target} is a model, not an endpoint, and takes no "
                f"{' or '.join(wrong)}; it is simulated at each of lengths_m"
            )
        return self


def _as_table(rig: Any) -> Any:
    return {"target": rig} if isinstance(rig, str) else rig


Rigs = Annotated[list[Annotated[SweptRig, BeforeValidator(_as_table)]], Field(min_length=1)]


class SweepDesign(SearchTable):
    """A sweep: each of its cells is one tuning.

    Attributes:
        lengths_m: Cable lengths, ascending. Models are simulated at each of them; a rig at an
            endpoint must stand within their range. Optional if all rigs are at endpoints.
        tensions_N: Preloads of the step, ascending; by default each rig's own suggestion.
        tuners: Names of tuners; by default that of `estune.tune`.
        seeds: Number of tunings at each place, each with noise of its own.
        rigs: Models and rigs; a string is short for `{target = "..."}`.
        start: Initial gains, by name, or where they come from: "model", "run:RUN", "law:SWEEP" or
            "law:RUNS"; by default each rig's own.
        step: The step trial.
        cost: The cost of a trial.
    """

    lengths_m: list[Positive] = Field(default=[])
    tensions_N: list[Positive] = Field(default=[])
    tuners: list[TunerName] = Field(default=[])
    seeds: Count = 1
    rigs: Rigs
    start: dict[str, NotNegative] | str = Field(default={})
    step: StepTable = StepTable()
    cost: CostTable = CostTable()

    @model_validator(mode="after")
    def _check(self) -> Self:
        wrong = [
            *_order_fault("lengths_m", self.lengths_m, "m"),
            *_order_fault("tensions_N", self.tensions_N, "N"),
            *_duplicates("tuners", self.tuners),
            *_duplicates("rigs", [rig.label for rig in self.rigs]),
        ]
        if len(self.lengths_m) == 1:
            wrong.append(
                f"lengths_m: {self.lengths_m[0]:g} m is one length only, which gives no law over "
                "length; give at least two, or tune once with: estune tune"
            )
        models = [rig.label for rig in self.rigs if rig.is_model]
        if models and not self.lengths_m:
            wrong.append(
                f"lengths_m: none is given, and {models[0]} is a model, to be simulated at each "
                "of them; give at least two"
            )
        if "preload_N" in self.step.given:
            wrong.append("step.preload_N: in a sweep that is tensions_N; give it there")
        wrong += [
            f"start.{name}: there is no such gain; the gains are {', '.join(GAIN_NAMES)}"
            for name in (() if isinstance(self.start, str) else self.start)
            if name not in GAIN_NAMES
        ]
        wrong += self.cost.too_long(self.step)
        if wrong:
            raise ValueError("\n".join(wrong))
        return self


def read_design(design: "SweepDesign | str | Path | Mapping[str, Any]") -> SweepDesign:
    """A design from its TOML file, whose paths are relative to it, or from a mapping.

    Raises:
        InvalidInput: it cannot be read, or is wrong; the message has one line for each fault.
    """
    if isinstance(design, SweepDesign):
        return design
    if isinstance(design, Mapping):
        return validate(SweepDesign, dict(design), "sweep")
    path = Path(design)
    read = validate(SweepDesign, read_toml(path), str(path))
    rigs = [_with_paths_from(rig, path.parent) for rig in read.rigs]
    return read.model_copy(update={"rigs": rigs})


def _with_paths_from(rig: SweptRig, folder: Path) -> SweptRig:
    """The rig with its paths resolved from a folder, and the label as it was written."""
    changes: dict[str, Any] = {}
    if rig.is_model and rig.target.endswith(targets.MODEL_FILE):
        changes |= {"name": rig.label, "target": str(folder / rig.target)}
    if rig.security is not None:
        changes |= {"security": folder / rig.security}
    return rig.model_copy(update=changes)


def _order_fault(key: str, values: list[float], unit: str) -> list[str]:
    duplicates = [value for value, count in Counter(values).items() if count > 1]
    if duplicates:
        fault = f"{key}: {duplicates[0]:g} {unit} appears more than once; give each once, and "
        return [fault + "the number of tunings as seeds"]
    for before, after in pairwise(values):
        if after < before:
            fault = f"{key}: {after:g} {unit} comes after {before:g} {unit}"
            return [f"{fault}; give them in ascending order"]
    return []


def _duplicates(key: str, names: list[str]) -> list[str]:
    return [
        f"{key}: {name} appears more than once; give each once, or names of their own"
        for name, count in Counter(names).items()
        if count > 1
    ]
