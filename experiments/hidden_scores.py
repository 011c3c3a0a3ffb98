"""One diagnosis of records with something hidden in them, and what it is worth."""

import time
import traceback
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

import plants
from estune.core.gains import Gains
from experiments import hidden_machines
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.result import ModelSummary
from plants.effects import EFFECTS
from plants.models.unloaded_reel import UnloadedReel

NAMING = ("named", "incomplete", "ambiguous")
FRICTION = "coulomb_friction"
FAIR = {
    "sector_rub": {"incomplete": FRICTION},
    "nonlinear_lag": dict.fromkeys(NAMING, "dead_time"),
    "quadratic_drag": dict.fromkeys(NAMING, "bent_viscous_friction"),
}
"""Effects without a name for which, by verdict, naming this family is no error."""


@dataclass(frozen=True)
class DiagnosisTask:
    """A case to be diagnosed, by its seed."""

    seed: int
    variant: str
    effect: str | None = None


@dataclass(frozen=True)
class Held:
    """Whether a stated interval holds the truth."""

    name: str
    true: float
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether it does."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Stated:
    """Stated probability that a family of effects is there, and whether it is."""

    family: str
    probability: float
    there: bool


VISIBLE = 1.5
"""Least gap, in floors, of a case that counts."""


@dataclass(frozen=True)
class Row:
    """One case: what was hidden, what was said, and how well the model then fits.

    `alone` is the gap that each of two effects makes without the other, in floors.
    """

    seed: int
    variant: str
    kind: str
    truth: tuple[str, ...]
    in_catalogue: bool
    verdict: str = "error"
    found: tuple[str, ...] = ()
    ambiguous: tuple[str, ...] = ()
    right: bool = False
    right_family: bool = False
    both_found: bool = False
    wrong_name: bool = False
    alone: tuple[float, ...] = ()
    ratio_before: float = float("nan")
    ratio_after: float = float("nan")
    closure: float = float("nan")
    rms_ratio: float = float("nan")
    cpu_s: float = float("nan")
    wall_s: float = float("nan")
    intervals: tuple[Held, ...] = field(default=())
    calibrations: tuple[Held, ...] = field(default=())
    stated: tuple[Stated, ...] = field(default=())
    accepted: tuple[tuple[str, ...], ...] = ()
    models: tuple[ModelSummary, ...] = ()
    error: str = ""

    @property
    def visible(self) -> bool:
        """Whether the gap is at least one and a half floors; a failure is never overlooked."""
        return bool(self.error) or self.ratio_before >= VISIBLE

    @property
    def each_visible(self) -> bool:
        """Whether each of two effects makes such a gap by itself."""
        return self.visible and min(self.alone, default=0.0) >= VISIBLE

    @property
    def gap_closed(self) -> float:
        """Share of the variance above the floor that the effects closed."""
        above = self.ratio_before**2 - 1.0
        return (self.ratio_before**2 - max(self.ratio_after, 1.0) ** 2) / above

    def as_json(self) -> dict[str, Any]:
        """All of it as JSON values."""
        models = [
            one._asdict() | {"names": sorted(one.names), "families": sorted(one.families)}
            for one in self.models
        ]
        return asdict(replace(self, models=())) | {"models": models}

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> "Row":
        """The row that `as_json` wrote."""
        known = {f.name for f in fields(cls)}
        values = {name: value for name, value in found.items() if name in known}
        for name in ("truth", "found", "ambiguous", "alone"):
            values[name] = tuple(values.get(name, ()))
        for name in ("intervals", "calibrations"):
            values[name] = tuple(Held(**held) for held in values[name])
        values["stated"] = tuple(Stated(**one) for one in values.get("stated", ()))
        values["accepted"] = tuple(map(tuple, values.get("accepted", ())))
        values["models"] = tuple(map(_model_summary, values.get("models", ())))
        return cls(**values)


def _model_summary(found: dict[str, Any]) -> ModelSummary:
    sets = {name: frozenset(found[name]) for name in ("names", "families")}
    return ModelSummary(**{name: (found | sets)[name] for name in ModelSummary._fields})


def measurement(record: hidden_machines.MachineRecord) -> MeasuredRecord:
    """A record as the workflow takes it."""
    about, columns = record.metadata, record.columns
    return MeasuredRecord(
        name=about["trial_id"],
        rig=about["rig"],
        sampling_Hz=about["sampling_Hz"],
        cable_length_m=about["cable_length_m"],
        preload_N=about["preload_N"],
        loop=about["loop"],
        profile=about["profile"],
        gains=Gains(**about["gains"]) if about["gains"] else None,
        time_s=columns["time_s"],
        setpoint_N=columns.get("setpoint_N"),
        current_A=columns.get("current_A"),
        tension_N=columns.get("tension_N"),
        angle_rad=columns.get("angle_rad"),
        reference_N=columns.get("reference_N"),
    )


def model(case: hidden_machines.Case) -> Any:
    """The model the machine's owner has of it."""
    if case.kind != "reel":
        return UnloadedReel(**case.given)
    about = case.records[0].metadata
    tension = min(max(about["preload_N"], 5.0), 40.0)
    return plants.reference_reel(about["cable_length_m"], tension, **case.given)


def choice(case: hidden_machines.Case, secret: hidden_machines.Secret) -> list[str] | None:
    """The effects to choose from; in one variant those of the truth's family are taken out."""
    if case.variant != "left_out":
        return None
    families = {hidden_machines.family(name) for name in secret.names}
    return [name for name in EFFECTS if hidden_machines.family(name) not in families]


def diagnose(task: DiagnosisTask) -> Row:
    """Draws a case, has it explained, and scores the answer; never raises."""
    case, secret = hidden_machines.draw(task.seed, task.variant, task.effect)
    row = Row(
        seed=task.seed,
        variant=task.variant,
        kind=case.kind,
        truth=secret.names,
        in_catalogue=secret.named and task.variant != "left_out",
    )
    records = [measurement(record) for record in case.records]
    if task.variant == "two":
        row = replace(row, alone=tuple(_gap_alone(task, name) for name in secret.names))
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        answer = plants.explain(model(case), records, effects=choice(case, secret))
    except Exception:  # noqa: BLE001  a diagnosis that fails is a result, and must not end the run
        return replace(row, error=traceback.format_exc(limit=-4))
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return score(answer, secret, replace(row, cpu_s=cpu, wall_s=wall))


def _gap_alone(task: DiagnosisTask, name: str) -> float:
    """Gap that one of the effects hidden makes where it acts without the other, in floors."""
    case, _ = hidden_machines.draw(task.seed, task.variant, task.effect, only=name)
    records = [measurement(record) for record in case.records]
    return float(plants.explain(model(case), records, effects=[]).before.ratio)


def score(answer: Any, secret: hidden_machines.Secret, row: Row) -> Row:
    """The row with what the diagnosis is worth."""
    found = tuple(sorted(effect.name for effect in answer.effects))
    named = found if answer.verdict in NAMING else ()
    accepted = secret.accepted if row.in_catalogue else ((),)
    exact = answer.verdict in ("named", "incomplete") if secret.names else answer.verdict == "none"
    right = exact and found in accepted
    families = {_families(names) for names in accepted}
    return replace(
        row,
        verdict=answer.verdict,
        found=named,
        ambiguous=tuple(answer.ambiguous),
        right=right,
        right_family=exact and _families(found) in families,
        both_found=bool(secret.names) and set(secret.names) <= set(named),
        wrong_name=_is_wrong(answer.verdict, named, accepted, secret.names),
        ratio_before=float(answer.before.ratio),
        ratio_after=float(answer.after.ratio),
        closure=float(answer.closure),
        rms_ratio=float(answer.after.rms / answer.before.rms),
        stated=_stated(answer, accepted),
        accepted=accepted,
        models=answer.models,
        intervals=_intervals(answer, secret),
        calibrations=_calibrations(answer, secret),
    )


def _families(names: tuple[str, ...]) -> frozenset[str]:
    return frozenset(map(hidden_machines.family, names))


def _is_wrong(
    verdict: str,
    named: tuple[str, ...],
    accepted: tuple[tuple[str, ...], ...],
    truth: tuple[str, ...],
) -> bool:
    """Whether a name is said that belongs to no effect that is there, by families."""
    there = {hidden_machines.family(name) for names in accepted for name in names}
    for name in truth:
        there |= {FAIR[name][verdict]} if verdict in FAIR.get(name, {}) else set()
    return not _families(named) <= there


def _stated(answer: Any, accepted: tuple[tuple[str, ...], ...]) -> tuple[Stated, ...]:
    """The probabilities of the families that were fitted, one of each."""
    there = {hidden_machines.family(name) for names in accepted for name in names}
    found = {
        hidden_machines.family(c.name): c.probability
        for c in answer.candidates
        if np.isfinite(c.gap)
    }
    return tuple(Stated(name, p, name in there) for name, p in found.items())


def _intervals(answer: Any, secret: hidden_machines.Secret) -> tuple[Held, ...]:
    """Of the parameters of effects that were found and are there."""
    return tuple(
        Held(f"{effect.name}.{name}", true, at.value, at.low, at.high)
        for effect in answer.effects
        for name, true in secret.parameters.get(effect.name, {}).items()
        for at in [effect.parameters[name]]
    )


def _calibrations(answer: Any, secret: hidden_machines.Secret) -> tuple[Held, ...]:
    """Of the machine's own numbers, as fitted with the effects.

    Without an encoder they are but ratios to the stiffness given, which the verdict says. A gain
    that is wrong and not named as an effect is the machine's own.
    """
    if any(one.kind == "no_encoder" for one in answer.limitations):
        return ()
    true = dict(secret.calibrations)
    if "gain_error" not in [effect.name for effect in answer.effects] and true:
        true["torque_gain"] *= 1.0 + secret.parameters.get("gain_error", {}).get("error", 0.0)
    return tuple(
        Held(one.name, true[one.name], at.value, at.low, at.high)
        for one in answer.calibrations
        if one.name in true
        for at in [one.with_effects]
    )
