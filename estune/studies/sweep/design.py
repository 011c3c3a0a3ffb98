"""What a sweep is to find out: its file, `sweep.toml`, or the same from Python."""

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
    """A model, made anew at every length, or a rig at an endpoint, which stands at one.

    Attributes:
        target: A model (`plants:reference_reel`, `reel.toml`) or an endpoint
            (`tcp/127.0.0.1:7447`).
        name: What the sweep calls it; the target itself if left out.
        rig: Name of the rig, where several answer at the endpoint.
        cable_length_m: Length at which a rig stands, where it does not say so itself.
        security: File that says who this is, where the rig asks.
    """

    target: str
    name: str = ""
    rig: str | None = None
    cable_length_m: Positive | None = None
    security: Path | None = Field(default=None, strict=False)

    @property
    def label(self) -> str:
        """What it is called in tables and messages."""
        return self.name or (self.target if self.rig is None else f"{self.rig}@{self.target}")

    @property
    def is_model(self) -> bool:
        """Whether it is simulated here."""
        return not targets.is_endpoint(self.target)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        given = {"rig": self.rig, "cable_length_m": self.cable_length_m, "security": self.security}
        wrong = [key for key, value in given.items() if value is not None and self.is_model]
        if wrong:
            raise ValueError(
                f"{wrong[0]}: {self.target} is a model, not an endpoint, and takes no "
                f"{' or '.join(wrong)}; it is made at each of lengths_m"
            )
        return self


def _as_table(rig: Any) -> Any:
    return {"target": rig} if isinstance(rig, str) else rig


Rigs = Annotated[list[Annotated[SweptRig, BeforeValidator(_as_table)]], Field(min_length=1)]


class SweepDesign(SearchTable):
    """A sweep: each of its cells is one tuning.

    Attributes:
        lengths_m: Cable lengths, rising. Models are made at each of them; a rig at an endpoint
            must stand within their range. May be left out where all rigs are at endpoints.
        tensions_N: Preloads of the step, rising; each rig's own suggestion if left out.
        tuners: How gains are proposed; `estune.tune`'s usual if left out.
        seeds: How often each tuning is repeated, with noise of its own.
        rigs: Models and rigs; a text is short for `{target = "..."}`.
        start: Gains to begin from, by name; each rig's own if left out.
        step: The step trial.
        cost: How a trial is scored.
    """

    lengths_m: list[Positive] = Field(default=[])
    tensions_N: list[Positive] = Field(default=[])
    tuners: list[TunerName] = Field(default=[])
    seeds: Count = 1
    rigs: Rigs
    start: dict[str, NotNegative] = Field(default={})
    step: StepTable = StepTable()
    cost: CostTable = CostTable()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        wrong = [
            *_not_rising("lengths_m", self.lengths_m, "m"),
            *_not_rising("tensions_N", self.tensions_N, "N"),
            *_twice("tuners", self.tuners),
            *_twice("rigs", [rig.label for rig in self.rigs]),
        ]
        if len(self.lengths_m) == 1:
            wrong.append(
                f"lengths_m: {self.lengths_m[0]:g} m is one length only, which gives no law over "
                "length; give at least two, or tune once with: estune tune"
            )
        models = [rig.label for rig in self.rigs if rig.is_model]
        if models and not self.lengths_m:
            wrong.append(
                f"lengths_m: none is given, and {models[0]} is a model, to be made at each of "
                "them; give at least two"
            )
        if self.step.preload_N is not None:
            wrong.append("step.preload_N: in a sweep that is tensions_N; give it there")
        wrong += [
            f"start.{name}: no gain; the gains are {', '.join(GAIN_NAMES)}"
            for name in self.start
            if name not in GAIN_NAMES
        ]
        wrong += self.cost.too_long(self.step)
        if wrong:
            raise ValueError("\n".join(wrong))
        return self


def read_design(design: "SweepDesign | str | Path | Mapping[str, Any]") -> SweepDesign:
    """A design from its TOML file, or from the same keys in Python.

    Paths in a file are beside it unless absolute.

    Raises:
        InvalidInput: it cannot be read, or something in it is wrong; all of it is in the message,
            a line each.
    """
    if isinstance(design, SweepDesign):
        return design
    if isinstance(design, Mapping):
        return validate(SweepDesign, dict(design), "sweep")
    path = Path(design)
    found = validate(SweepDesign, read_toml(path), str(path))
    rigs = [_beside(rig, path.parent) for rig in found.rigs]
    return found.model_copy(update={"rigs": rigs})


def _beside(rig: SweptRig, folder: Path) -> SweptRig:
    """A rig whose files are found from anywhere; its name is as it was written."""
    changed: dict[str, Any] = {}
    if rig.is_model and rig.target.endswith(targets.MODEL_FILE):
        changed |= {"name": rig.label, "target": str(folder / rig.target)}
    if rig.security is not None:
        changed |= {"security": folder / rig.security}
    return rig.model_copy(update=changed)


def _not_rising(key: str, values: list[float], unit: str) -> list[str]:
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        said = f"{key}: {twice[0]:g} {unit} is there more than once; give each once, and say how "
        return [said + "often it is to be tuned by seeds"]
    for before, after in pairwise(values):
        if after < before:
            return [f"{key}: {after:g} {unit} comes after {before:g} {unit}; give them rising"]
    return []


def _twice(key: str, names: list[str]) -> list[str]:
    return [
        f"{key}: {name} is there more than once; give each once, or names of their own"
        for name, count in Counter(names).items()
        if count > 1
    ]
