"""A diagnosis as JSON values; the keys are read by other programs and do not change."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from plants.diagnosis.next_data import NextExperiment, NextRecording
from plants.diagnosis.report import summary
from plants.diagnosis.report.plant_units import own_names
from plants.diagnosis.result import (
    Candidate,
    DeclaredEffect,
    DiagnosisResult,
    HoldOut,
    NamedEffect,
    SearchStep,
)
from plants.effects import Effect
from plants.effects.plant_scale import PlantScale
from plants.remedies.text import to_json as remedies_to_json


def to_json(d: DiagnosisResult) -> dict[str, Any]:
    """The diagnosis as JSON values; what is not a finite number is null."""
    unit = d.unit
    errors = {"given": d.given, "before": d.before, "after": d.after}
    declared = {type(e).name: type(e) for e in getattr(d.model, "effects", ())}
    values = {
        "heading": summary.heading(d),
        "verdict": d.verdict,
        "sentence": d.sentence,
        "effects": [_effect(named, type(named.effect), d) for named in d.effects],
        "ambiguous": d.ambiguous,
        "candidates": [_candidate(c, d) for c in d.candidates],
        **{f"gap_{name}_{unit}": e.gap for name, e in errors.items()},
        f"floor_{unit}": d.floor,
        **{f"gap_{name}_floors": e.ratio for name, e in errors.items()},
        "closure": d.closure,
        **{f"free_run_{name}_{unit}": e.rms for name, e in errors.items()},
        "where": d.where.to_json(),
        "unexplained": d.unexplained.to_json(),
        "not_excited": d.not_excited,
        "ruled_out": d.ruled_out,
        "next_experiment": d.next_experiment and _trial(d.next_experiment),
        "next_recording": d.next_recording and _recording(d.next_recording),
        "declared": [_effect(named, declared[named.name], d) for named in d.declared],
        "hold_out": d.hold_out and _hold_out(d.hold_out, unit),
        "calibrations": {c.name: _fields(c, "name") for c in d.calibrations},
        "steps": [_step(step, unit) for step in d.steps],
        "noise": d.noise.channels,
        "exit_code": d.exit_code,
        "limitations": d.limitations,
        "findings": d.findings,
        "remedies": remedies_to_json(d.remedies()),
    }
    return {name: finite_json(value) for name, value in values.items()}


def _fields(value: Any, without: str = "") -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in fields(value) if f.name != without}


def _effect(
    named: NamedEffect | DeclaredEffect, effect: type[Effect], d: DiagnosisResult
) -> dict[str, Any]:
    """An effect of a class; its parameters by names that end in the plant's own units."""
    names = own_names(effect, named.parameters, PlantScale.of(d.base_model))
    parameters = {names[name]: at for name, at in named.parameters.items()}
    return _fields(named, "effect") | {"parameters": parameters}


def _candidate(c: Candidate, d: DiagnosisResult) -> dict[str, Any]:
    gaps = {f"gap_{d.unit}": c.gap * d.floor, "gap_floors": c.gap}
    shares = {"closure": c.closure, "explains": c.cosine2, "probability": c.probability}
    shares["own_probability"] = c.own_probability
    return {"name": c.name, **gaps, **shares, "sentence": c.sentence}


def _trial(trial: NextExperiment) -> dict[str, Any]:
    named = {"name": trial.trial.name, "file": trial.file_name, "command": trial.command}
    others = {"sentence": trial.sentence, "separation": trial.separation, "tried": trial.tried}
    return named | others | {"profile": trial.trial.profile}


def _recording(recording: NextRecording) -> dict[str, Any]:
    return {"file": recording.file_name, "sentence": recording.sentence}


def _hold_out(held: HoldOut, unit: str) -> dict[str, Any]:
    names = (f"gap_{unit}", "gap_floors", f"free_run_{unit}")
    models = zip(("given", "base", "with_effects"), held[2:], strict=True)
    errors = {name: dict(zip(names, e, strict=True)) for name, e in models}
    return {"records": held.records, f"floor_{unit}": held.floor, **errors}


def _step(step: SearchStep, unit: str) -> dict[str, Any]:
    errors = {f"gap_{unit}": step.gap, f"floor_{unit}": step.floor}
    return {"effect": step.effect, **errors, "gap_floors": step.ratio}


def finite_json(value: Any) -> Any:
    """JSON values of anything, with null for every number that is not finite."""
    if is_dataclass(value):
        value = _fields(value)
    if isinstance(value, Mapping):
        return {str(key): finite_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_json(item) for item in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    return float(value) if math.isfinite(value) else None
