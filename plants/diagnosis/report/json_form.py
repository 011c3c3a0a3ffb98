"""A diagnosis as JSON values; the keys are read by other programs and do not change."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from plants.diagnosis.result import (
    BaseParameter,
    DeclaredEffect,
    DiagnosisResult,
    HoldOut,
    SearchStep,
)


def to_json(d: DiagnosisResult) -> dict[str, Any]:
    """The diagnosis as JSON values; what is not a finite number is null."""
    unit = d.unit
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
        f"gap_given_{unit}": d.given.gap,
        f"gap_before_{unit}": d.gap_before,
        f"gap_after_{unit}": d.gap_after,
        f"floor_{unit}": d.floor,
        "gap_given_floors": d.given.ratio,
        "gap_before_floors": d.ratio_before,
        "gap_after_floors": d.ratio_after,
        "closure": d.closure,
        f"free_run_given_{unit}": d.given.rms,
        f"free_run_before_{unit}": d.rms_before,
        f"free_run_after_{unit}": d.rms_after,
        "where": d.where.to_json(),
        "not_excited": d.not_excited,
        "ruled_out": d.ruled_out,
        "next_experiment": d.next_experiment and d.next_experiment.to_json(),
        "declared": [_declared(effect) for effect in d.declared],
        "hold_out": d.hold_out and _hold_out(d.hold_out, unit),
        "calibrations": {c.name: _shift(c) for c in d.calibrations},
        "steps": [_step(step, unit) for step in d.steps],
        "noise": d.noise.to_json(),
        "exit_code": d.exit_code,
        "limitations": [asdict(one) for one in d.limitations],
        "findings": [asdict(finding) for finding in d.findings],
        "splits": [asdict(part) for part in d.splits],
    }
    return {name: finite_json(value) for name, value in values.items()}


def _declared(effect: DeclaredEffect) -> dict[str, Any]:
    fitted = {name: asdict(one) for name, one in effect.parameters.items()}
    return asdict(effect) | {"parameters": fitted}


def _hold_out(held: HoldOut, unit: str) -> dict[str, Any]:
    models = {"given": held.given, "base": held.base, "with_effects": held.with_effects}
    errors = {
        name: {f"gap_{unit}": e.gap, "gap_floors": e.ratio, f"free_run_{unit}": e.rms}
        for name, e in models.items()
    }
    return {"records": held.records, f"floor_{unit}": held.floor, **errors}


def _shift(c: BaseParameter) -> dict[str, Any]:
    fitted = {"base": asdict(c.base), "with_effects": asdict(c.with_effects)}
    return {"unit": c.unit, "given": c.given, **fitted}


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
