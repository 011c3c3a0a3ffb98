"""Identification of the effect that a model lacks, from records, in one call."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from estune.errors import InvalidInput
from estune.trial import RigDescription, TrialRecord
from plants.diagnosis.build_diagnosis import (
    DiagnosisInputs,
    EffectChoices,
    FittedModel,
    build_diagnosis,
)
from plants.diagnosis.checks.quality import check
from plants.diagnosis.data.measured_record import DataIssue, MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor, noise_floor
from plants.diagnosis.data.records import read_measurements
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.models.diagnosed_model import DiagnosedModel, diagnosed
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.residual.localisation import ResidualLocation, localise
from plants.diagnosis.search import thresholds
from plants.diagnosis.search.candidate_fits import coarse_fit
from plants.diagnosis.search.data_splits import FIT, RANK
from plants.diagnosis.search.initial_guesses import suggestions
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.rule_based import MainsLine, coarse_step_N, find_mains_interference
from plants.diagnosis.search.stepwise import search
from plants.diagnosis.search.verdict import conclude
from plants.diagnosis.search.wrong_parameter import find_wrong_parameter
from plants.effects import (
    CableWeight,
    CoulombFriction,
    Effect,
    MainsInterference,
    Quantisation,
    declared,
    find,
)

HUM_ROUNDS = 2
"""Searches for mains interference; the second is without the line found first."""


def explain(
    model: Any,
    records: Path | str | Sequence[MeasuredRecord] | Sequence[TrialRecord],
    *,
    effects: Sequence[type[Effect] | str] | None = None,
    rig: RigDescription | None = None,
) -> Diagnosis:
    """Identifies the effect that a model lacks, from records; deterministic.

    Args:
        model: A `Reel`, an `UnloadedReel`, a linear or a Python plant, or a system of
            python-control.
        records: A folder of records, or the records themselves.
        effects: The effects to choose from, classes or names for `plants.effects.find`; None is
            all that are declared, those of other packages included.
        rig: The rig of the next experiment; None derives it from the records.

    Raises:
        InvalidInput: there is no record that can be used; the message says why for each.
        PlantError: the model cannot be simulated.
    """
    # The matrices are small: a thread more costs more than it brings, and a core that another
    # diagnosis could have.
    with threadpool_limits(limits=1, user_api="blas"):
        return _explained(model, records, effects, rig)


def _explained(
    model: Any,
    records: Path | str | Sequence[MeasuredRecord] | Sequence[TrialRecord],
    effects: Sequence[type[Effect] | str] | None,
    rig: RigDescription | None,
) -> Diagnosis:
    given, read = _measurements(records)
    measurements, looked = check(given, model)
    findings = (*read, *looked)
    if not measurements:
        refused = "; ".join(str(f) for f in findings if f.level == "refused")
        raise InvalidInput(f"no record can be used: {refused or 'there is none'}")
    noise = noise_floor(measurements)
    bench, base = _base(model, measurements, noise)
    choice = _choice(bench.model, effects)
    humming = FittedModel(bench, base)
    hum = None
    for _ in range(HUM_ROUNDS if MainsInterference in choice.by_rule else 0):
        line = _hum(bench, base, measurements)
        if line is None:
            break
        hum, (bench, base) = line, _base(model, line.measurements, noise)
    where = _where(bench, base, noise)
    suggest = suggestions(measurements, where, base.values)
    found = search(bench, base, choice.structural, suggest)
    if hum is not None and found.best.effects and not _still(humming, found.best):
        # The line was what the effects do.
        hum, (bench, base) = None, humming
        where = _where(bench, base, noise)
        suggest = suggestions(measurements, where, base.values)
        found = search(bench, base, choice.structural, suggest)
    judged = conclude(found)
    wrong = None
    if judged.verdict == "none" and hum is None:
        wrong = find_wrong_parameter(bench, base, choice.calibrations)
    coarse = None
    if Quantisation in choice.by_rule and "tension_N" in noise.channels:
        coarse = coarse_step_N(noise.channels["tension_N"])
    return build_diagnosis(
        DiagnosisInputs(
            model=model,
            humming=humming,
            hum=hum,
            bench=bench,
            found=found,
            judged=judged,
            wrong=wrong,
            coarse_step_N=coarse,
            choice=choice,
            where=where,
            noise=noise,
            findings=findings,
            rig=rig,
        )
    )


def _base(model: Any, measurements: tuple[MeasuredRecord, ...], noise: NoiseFloor) -> FittedModel:
    """The base fit, of the variant of the model that suits the records."""
    stages = []
    for plant in diagnosed(model, measurements).alternatives():
        bench = ModelFitter(plant, measurements, noise)
        stages.append(FittedModel(bench, bench.attempt((), bench.base.start[None, :])))
    if len(stages) == 1:
        return stages[0]
    least = min(stage.attempt.fit_J for stage in stages)
    return min(stages, key=_meant if least > thresholds.GAP**2 else lambda s: s.attempt.fit_J)


def _meant(stage: FittedModel) -> float:
    """Least error of a variant of the model, alone or with the effect that reveals its sag.

    In the linear law, added weight stands for the sag.
    """
    beside = CoulombFriction if stage.bench.model.is_often_slack else CableWeight
    return min(stage.attempt.fit_J, coarse_fit(stage.bench, beside).fit_J)


def _where(bench: ModelFitter, base: CandidateFit, noise: NoiseFloor) -> ResidualLocation:
    """Localisation of the base model's residual."""
    model = bench.model.calibrated(base.values)
    numbers = [BaseNumbers.of(model, m) for m in bench.measurements]
    return localise(bench.measurements, numbers, noise)


def _still(humming: FittedModel, best: CandidateFit) -> bool:
    """Whether the records show mains interference with the effects in the model."""
    row = humming.bench.predictor(best.effects).row(best.values)
    attempt = humming.bench.attempt(best.effects, row[None, :])
    return _hum(humming.bench, attempt, humming.bench.measurements) is not None


def _measurements(
    records: Path | str | Sequence[MeasuredRecord] | Sequence[TrialRecord],
) -> tuple[tuple[MeasuredRecord, ...], tuple[DataIssue, ...]]:
    if isinstance(records, Path | str):
        read = read_measurements(records)
        return read.measurements, read.findings
    return tuple(r if isinstance(r, MeasuredRecord) else MeasuredRecord.of(r) for r in records), ()


def _choice(plant: DiagnosedModel, effects: Sequence[type[Effect] | str] | None) -> EffectChoices:
    asked = (
        declared() if effects is None else [find(e) if isinstance(e, str) else e for e in effects]
    )
    reasons = {e.name: plant.unavailable(e) for e in asked}
    had = [e for e in asked if reasons[e.name] is None]
    return EffectChoices(
        structural=tuple(e for e in had if not (e.base_parameter or e.in_noise)),
        calibrations=tuple(e for e in had if e.base_parameter),
        by_rule=tuple(e for e in had if e.in_noise),
        unavailable={name: why for name, why in reasons.items() if why is not None},
    )


def _hum(
    bench: ModelFitter, base: CandidateFit, measurements: Sequence[MeasuredRecord]
) -> MainsLine | None:
    """Mains interference in a model's residual of the gauge outside the test data."""
    if "tension_N" not in bench.floor.channels:
        return None
    fitted, index = base.fitted, bench.base.index
    predicted = fitted.predictor.predict(fitted.values[None, :])
    looked = bench.split.where(FIT, RANK)
    seen = []
    for n, m in enumerate(measurements):
        at = np.zeros(m.samples, bool)
        at[index.sample[looked[index.measurement[looked] == n]]] = True
        # Of a record that is all report only its own phase is wanted.
        seen.append(at if at.any() else ~at)
    left = [None if p.tension_N is None else p.tension_N[0] for p in predicted]
    return find_mains_interference(measurements, left, seen, bench.floor.tension_N)
