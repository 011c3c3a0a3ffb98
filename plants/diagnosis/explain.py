"""Identification of the effect that a model lacks, from records, in one call."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estune.recordings.column_map import AS_NAMED, ColumnMap
from estune.support.blas import one_blas_thread
from estune.trial import RigDescription, TrialRecord
from plants.diagnosis.build_diagnosis import (
    DiagnosisInputs,
    EffectChoices,
    FittedModel,
    ModelSearch,
    build_diagnosis,
)
from plants.diagnosis.checks.quality import check
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor, noise_floor
from plants.diagnosis.data.records import FolderContents, drum_of, read_measurements
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.models.diagnosed_model import DiagnosedModel, diagnosed
from plants.diagnosis.progress import Progress, portion, silent
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.residual.localisation import localise
from plants.diagnosis.residual.torque_waves import torque_waves
from plants.diagnosis.search.conclusion import conclude
from plants.diagnosis.search.constants import CONSTANTS
from plants.diagnosis.search.initial_guesses import record_scale
from plants.diagnosis.search.mains_interference import (
    MainsLine,
    coarse_step_N,
    find_mains_interference,
)
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.more_records import carried_over, confirmed, differing
from plants.diagnosis.search.search import search
from plants.diagnosis.search.starts import coarse_fit
from plants.diagnosis.search.wrong_parameter import find_wrong_parameter
from plants.effects import (
    CableWeight,
    Cogging,
    CoulombFriction,
    Effect,
    MainsInterference,
    Quantisation,
    declared,
    find,
)

Records = Path | str | Sequence[MeasuredRecord] | Sequence[TrialRecord]
LINE_ROUNDS = 2
"""Searches for mains interference; the second is without the line found first."""
SAME, OTHER = 0.995, 0.9
"""Ratio of powers left above which two variants of a model are the same; below the second, the
one that leaves more is none."""


def explain(
    model: Any,
    records: Records,
    *,
    effects: Sequence[type[Effect] | str] | None = None,
    rig: RigDescription | None = None,
    columns: ColumnMap = AS_NAMED,
    hold_out: Records | None = None,
    progress: Progress = silent,
) -> Diagnosis:
    """Identifies the effect that a model lacks, from records; deterministic.

    Args:
        model: A `Reel`, an `UnloadedReel`, a linear or a Python plant, or a system of
            python-control.
        records: A folder of records, or the records themselves.
        effects: The effects to choose from, classes or names for `plants.effects.find`; None is
            all that are declared, those of other packages included.
        rig: The rig of the next experiment; None derives it from the records.
        columns: Where the columns come from, in files that name them otherwise.
        hold_out: Records that no model is fitted to; the errors on them are reported.
        progress: Called with the phase in words and the estimated share of the work that is done,
            0 to 1, in the caller's thread: as each phase begins and after each candidate effect.

    Raises:
        InvalidInput: there is no record that can be used; the message says why for each.
        PlantError: the model cannot be simulated.
    """
    progress("reading the records", 0.0)
    read = _read(records, model, columns)
    held = None if hold_out is None else _read(hold_out, model, columns)
    with one_blas_thread():
        return _explained(model, read, held, effects, rig, progress=progress)


def _read(records: Records, model: Any, columns: ColumnMap) -> FolderContents:
    if isinstance(records, Path | str):
        return read_measurements(records, columns, drum_of(model))
    return FolderContents(tuple(map(_measured, records)), ())


def _explained(
    model: Any,
    read: FolderContents,
    held: FolderContents | None,
    effects: Sequence[type[Effect] | str] | None,
    rig: RigDescription | None,
    *,
    progress: Progress,
) -> Diagnosis:
    progress("checking the records", 0.02)
    measurements, looked = check(read.measurements, model)
    findings = (*read.findings, *looked)
    noise = noise_floor(measurements)
    recorded, line, done, choice = _searches(model, measurements, noise, effects, progress)
    progress("refitting with parts left out", 0.85)
    wrong = coarse = aside = None
    if done.judged.verdict == "none" and line is None:
        wrong = find_wrong_parameter(done.fitter, done.found, choice.calibrations)
    if Quantisation in choice.in_noise and "tension_N" in noise.channels:
        coarse = coarse_step_N(noise.channels["tension_N"])
    if held is not None:
        aside = _for_records(model, check(held.measurements, model)[0], done.fitter.model)
    waves = None
    if Cogging in choice.in_torque and done.judged.verdict in ("unknown", "none"):
        numbers = [BaseNumbers.of(model, m) for m in measurements]
        found = torque_waves(measurements, numbers, () if aside is None else aside.measurements)
        waves = found if found is not None and found.share >= CONSTANTS.named_share else None
    inputs = DiagnosisInputs(
        model=model,
        recorded=recorded,
        line=line,
        done=done,
        wrong=wrong,
        coarse_step_N=coarse,
        choice=choice,
        noise=noise,
        findings=findings,
        rig=rig,
        held=aside,
        waves=waves,
    )
    diagnosis = build_diagnosis(inputs)
    progress("done", 1.0)
    return diagnosis


def _searches(
    model: Any,
    measurements: tuple[MeasuredRecord, ...],
    noise: NoiseFloor,
    effects: Sequence[type[Effect] | str] | None,
    progress: Progress,
) -> tuple[FittedModel, MainsLine | None, ModelSearch, EffectChoices]:
    """The base fit of the records as they are, their interference, the search without it."""
    progress("fitting the model as given", 0.08)
    some = differing(measurements)
    variants = _variants(model, some, noise)
    recorded, line = variants[0], None
    choice = _choice(recorded.fitter.model, effects)
    for _ in range(LINE_ROUNDS if MainsInterference in choice.in_noise else 0):
        again = _line(*variants[0], some)
        if again is None:
            break
        line, variants = again, _variants(model, again.measurements, noise)
    end = 0.85 if len(some) == len(measurements) else 0.4
    done = _searched(variants, choice, noise, portion(progress, 0.2, end))
    if line is not None and done.judged.best.effects and not _remains(recorded, done.judged.best):
        # The line was what the effects do.
        line, done = None, _searched((recorded,), choice, noise, portion(progress, end, end))
    if len(some) < len(measurements):
        progress("confirming on all records", end)
        recorded, line, done = _on_all(model, measurements, noise, line, done)
    return recorded, line, done, choice


def _on_all(
    model: Any,
    measurements: tuple[MeasuredRecord, ...],
    noise: NoiseFloor,
    line: MainsLine | None,
    done: ModelSearch,
) -> tuple[FittedModel, MainsLine | None, ModelSearch]:
    """Result of a search on some of the records, fitted to all and judged again."""
    fitter = ModelFitter(_for_records(model, measurements, done.fitter.model), measurements, noise)
    recorded = FittedModel(fitter, carried_over(fitter, done.found.base))
    if line is not None:
        line = _line(fitter, carried_over(fitter, done.judged.best), measurements)
    if line is not None:
        cleaned = _for_records(model, line.measurements, done.fitter.model)
        fitter = ModelFitter(cleaned, line.measurements, noise)
    found = confirmed(fitter, done.found, done.judged)
    judged = conclude(fitter, found)
    return recorded, line, done._replace(fitter=fitter, found=found, judged=judged)


def _for_records(
    model: Any, measurements: Sequence[MeasuredRecord], fitted: DiagnosedModel
) -> DiagnosedModel:
    """The model as given for other records, in the variant that was fitted."""
    kinds = diagnosed(model, measurements).alternatives()
    return next((k for k in kinds if type(k.calibration) is type(fitted.calibration)), kinds[0])


def _searched(
    variants: Sequence[FittedModel], choice: EffectChoices, noise: NoiseFloor, progress: Progress
) -> ModelSearch:
    """The search on the variant of the model in which it leaves the least."""
    done, each = [], 1.0 / len(variants)
    for n, (fitter, base) in enumerate(variants):
        model = fitter.model.calibrated(base.values)
        numbers = [BaseNumbers.of(model, m) for m in fitter.measurements]
        where = localise(fitter.measurements, numbers, noise)
        records = record_scale(fitter, where, base.values)
        part = portion(progress, n * each, (n + 1) * each)
        found = search(fitter, base, choice.structural, records, part)
        done.append(ModelSearch(fitter, where, found, conclude(fitter, found)))
    return min(done, key=lambda one: one.judged.best.J)


def _variants(
    model: Any, measurements: tuple[MeasuredRecord, ...], noise: NoiseFloor
) -> tuple[FittedModel, ...]:
    """The base fits of the variants of the model that may suit the records, the likelier first."""
    stages = []
    for plant in diagnosed(model, measurements).alternatives():
        fitter = ModelFitter(plant, measurements, noise)
        stages.append(FittedModel(fitter, fitter.base_fit()))
    if len(stages) == 1:
        return (stages[0],)
    left = [stage.fit.J for stage in stages]
    sound = min(left) <= CONSTANTS.nothing
    if not sound:
        left = [_meant(stage) for stage in stages]
    ratio = left[1] / left[0]
    if ratio < (SAME if sound else OTHER):
        return (stages[1],)
    return (stages[1], stages[0]) if ratio < SAME and not sound else (stages[0],)


def _meant(stage: FittedModel) -> float:
    """Least error of a variant of the model, alone or with the effect that reveals its sag.

    In the linear law, added weight stands for the sag.
    """
    beside = CoulombFriction if stage.fitter.model.is_often_slack else CableWeight
    return min(stage.fit.J, coarse_fit(stage.fitter, beside).J)


def _remains(recorded: FittedModel, best: CandidateFit) -> bool:
    """Whether the records show mains interference with the effects in the model."""
    fitter = recorded.fitter
    row = fitter.predictor(best.effects).row(best.values)
    return _line(fitter, fitter.fit(best.effects, row), fitter.measurements) is not None


def _measured(record: MeasuredRecord | TrialRecord) -> MeasuredRecord:
    return record if isinstance(record, MeasuredRecord) else MeasuredRecord.of(record)


def _choice(plant: DiagnosedModel, effects: Sequence[type[Effect] | str] | None) -> EffectChoices:
    asked = (
        declared() if effects is None else [find(e) if isinstance(e, str) else e for e in effects]
    )
    reasons = {e.name: plant.unavailable(e) for e in asked}
    had = [e for e in asked if reasons[e.name] is None]
    return EffectChoices(
        structural=tuple(e for e in had if not (e.base_parameter or e.in_noise or e.in_torque)),
        calibrations=tuple(e for e in had if e.base_parameter),
        in_noise=tuple(e for e in had if e.in_noise),
        in_torque=tuple(e for e in had if e.in_torque),
        unavailable={name: why for name, why in reasons.items() if why is not None},
        shown_by={e.name: e.excitation for e in asked},
    )


def _line(
    fitter: ModelFitter, one: CandidateFit, measurements: Sequence[MeasuredRecord]
) -> MainsLine | None:
    """Mains interference in what a model leaves of the gauge's readings."""
    if "tension_N" not in fitter.floor.channels:
        return None
    predicted = one.fitted.predictor.predict(one.fitted.values[None, :])
    left = [None if p.tension_N is None else p.tension_N[0] for p in predicted]
    return find_mains_interference(measurements, left, fitter.floor.tension_N)
