"""A diagnosis as JSON values; the keys are read by other programs and do not change."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from plants.diagnosis.result import DiagnosisResult, HoldOut, NextExperiment, SearchStep


def to_json(d: DiagnosisResult) -> dict[str, Any]:
    """The diagnosis as JSON values; what is not a finite number is null."""
    unit = d.unit
    errors = {"given": d.given, "before": d.before, "after": d.after}
    values = {
        "verdict": d.verdict,
        "sentence": d.sentence,
        "effects": [
            {
                "name": effect.name,
                "title": effect.title,
                "sentence": effect.sentence,
                "parameters": {n: asdict(i) for n, i in effect.parameters.items()},
            }
            for effect in d.effects
        ],
        "ambiguous": d.ambiguous,
        "candidates": [
            {
                "name": c.name,
                f"gap_{unit}": c.gap * d.floor,
                "gap_floors": c.gap,
                "closure": c.closure,
                "explains": c.cosine2,
                "probability": c.probability,
                "sentence": c.sentence,
            }
            for c in d.candidates
        ],
        **{f"gap_{name}_{unit}": e.gap for name, e in errors.items()},
        f"floor_{unit}": d.floor,
        **{f"gap_{name}_floors": e.ratio for name, e in errors.items()},
        "closure": d.closure,
        **{f"free_run_{name}_{unit}": e.rms for name, e in errors.items()},
        "where": d.where.to_json(),
        "not_excited": d.not_excited,
        "ruled_out": d.ruled_out,
        "next_experiment": d.next_experiment and _trial(d.next_experiment),
        "declared": [asdict(effect) for effect in d.declared],
        "hold_out": d.hold_out and _hold_out(d.hold_out, unit),
        "calibrations": {
            c.name: {k: v for k, v in asdict(c).items() if k != "name"} for c in d.calibrations
        },
        "steps": [_step(step, unit) for step in d.steps],
        "noise": d.noise.to_json(),
        "exit_code": d.exit_code,
        "limitations": [asdict(one) for one in d.limitations],
        "findings": [asdict(finding) for finding in d.findings],
        "splits": [asdict(part) for part in d.splits],
    }
    return {name: finite_json(value) for name, value in values.items()}


def _trial(one: NextExperiment) -> dict[str, Any]:
    named = {"name": one.trial.name, "file": one.file_name, "command": one.command}
    rest = {"sentence": one.sentence, "separation": one.separation, "tried": one.tried}
    return named | rest | {"profile": asdict(one.trial.profile)}


def _hold_out(held: HoldOut, unit: str) -> dict[str, Any]:
    names = (f"gap_{unit}", "gap_floors", f"free_run_{unit}")
    models = zip(("given", "base", "with_effects"), held[2:], strict=True)
    errors = {name: dict(zip(names, e, strict=True)) for name, e in models}
    return {"records": held.records, f"floor_{unit}": held.floor, **errors}


def _step(step: SearchStep, unit: str) -> dict[str, Any]:
    errors = {f"gap_{unit}": step.gap, f"floor_{unit}": step.floor}
    return {"effect": step.effect, **errors, "gap_floors": step.ratio}


def finite_json(value: Any) -> Any:
    """JSON values with null for every number that is not finite."""
    if isinstance(value, Mapping):
        return {str(key): finite_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_json(item) for item in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    return float(value) if math.isfinite(value) else None
