"""Step 8: the verdict with all its evidence, in words and in the plant's own units."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from estune.core.gains import Gains
from estune.trial import RigDescription
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import OUTPUTS
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.data.records import FolderContents
from plants.diagnosis.declared_effects import declared_effects
from plants.diagnosis.experiments.next_experiment import Evidence, next_experiment
from plants.diagnosis.experiments.next_recording import next_recording
from plants.diagnosis.interval import Interval
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.models.free_parameters import BASE
from plants.diagnosis.next_data import NextExperiment, NextRecording
from plants.diagnosis.pipeline.compare import EffectComparison
from plants.diagnosis.pipeline.intervals import StatedIntervals
from plants.diagnosis.prediction.prediction import Prediction
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.report.plant_units import in_own_units, located_in_own_units
from plants.diagnosis.residual.localisation import ResidualLocation, localise
from plants.diagnosis.result import (
    BaseParameter,
    Limitation,
    ModelErrors,
    NamedEffect,
    SearchStep,
    Trace,
)
from plants.diagnosis.search.conclusion import candidates, not_excited, verdict_sentence
from plants.diagnosis.search.limitations import limitations
from plants.diagnosis.search.model_fitter import CandidateFit
from plants.diagnosis.search.validation import (
    ModelStage,
    free_run_rms,
    held_errors,
    hold_out,
)
from plants.diagnosis.torque_balance.agreement import sentence as of_balance
from plants.effects import Effect
from plants.effects.plant_scale import PlantScale, si, written_unit


def report(
    model: Any,
    usable: FolderContents,
    compared: EffectComparison,
    stated: StatedIntervals,
    *,
    held_out: DiagnosedModel | None,
    rig: RigDescription | None,
) -> Diagnosis:
    """The diagnosis; `held_out` is the model as given for records that no model was fitted to."""
    fitted, choices = compared.fitted, compared.fitted.choices
    before, after = compared.stages[0], compared.stages[-1]
    # In words as of the plant that was fitted: a system of python-control has units only there.
    plant, steps = after.fitter.model, compared.steps
    scale = PlantScale.of(plant.model)
    effects = [_named(e, stated.believed, plant.model) for e in compared.effects]
    # Base numbers that were fitted without the waves compensate for them.
    believed = after.fit if compared.waves is None else compared.models.given
    values = believed.values
    if compared.waves is not None:
        values["torque_offset_Nm"] = compared.waves.offset_Nm
    for effect in (named.effect for named in effects):
        values |= {f"{effect.name}.{n}": getattr(effect, n) for n in effect.parameters()}
    limits = limitations(after.fitter.measurements, usable.findings, believed, scale)
    following = _next(compared, rig)
    runs = [each.fitter.free_run(each.fit) for each in (before, after)]
    unexplained = fitted.where
    if effects and compared.waves is None:  # waves of the torque are in no run
        unexplained = _unexplained(after, runs[1], fitted.noise)
    return Diagnosis(
        verdict=compared.verdict,
        sentence=_sentence(compared, effects, limits, stated),
        effects=tuple(effects),
        ambiguous=compared.conclusion.tied if compared.verdict == "ambiguous" else (),
        candidates=candidates(compared.screening, compared.models, compared.conclusion),
        unit=scale.unit(plant.output),
        given=held_errors(before.fitter, before.fitter.given()),
        before=_errors(steps[0], before),
        after=_errors(steps[-1], after),
        floor=steps[0].floor,
        noise=fitted.noise,
        where=located_in_own_units(fitted.where, scale),
        unexplained=located_in_own_units(unexplained, scale),
        calibrations=_calibrations(before.fit, stated, scale),
        not_excited={
            **not_excited(compared.screening, compared.effects),
            **choices.unavailable,
        },
        next_experiment=following,
        gains=_live_gains(compared),
        next_recording=None if following is not None else _recording(compared),
        findings=usable.findings,
        steps=steps,
        traces=_traces(before, after, runs),
        model=model,
        base_model=plant.calibrated(compared.start.values),
        augmented=plant.calibrated(values, compared.effects),
        values=values,
        declared=declared_effects(plant, fitted.noise, compared.start, stated.base),
        hold_out=None if held_out is None else hold_out(held_out, before.fit, after.fit),
        limitations=limits,
        models=compared.conclusion.models,
        shown_by=choices.shown_by,
        not_of_the_plant=frozenset(choices.unavailable),
    )


def _sentence(
    compared: EffectComparison,
    effects: Sequence[NamedEffect],
    limits: Sequence[Limitation],
    stated: StatedIntervals,
) -> str:
    plant = compared.fitter.model
    scale, unit = PlantScale.of(plant.model), written_unit(plant.output, plant.model)
    judged, together = compared.judged, compared.together
    if compared.waves is not None:
        verdict = f"{effects[-1].sentence} {compared.waves.sentence(scale)}"
    elif judged is not None and together.weight == "balance":
        before, after = compared.steps[0], compared.steps[-1]
        errors = f"{si(before.gap, unit)} without and {si(after.gap, unit)} with it"
        rest = f" What is left looks like {judged.like}." if judged.like else ""
        sentences = " ".join(effect.sentence for effect in effects)
        verdict = (
            f"{sentences} {of_balance(judged, together, scale)}: short predictions are off by "
            f"{errors}.{rest}"
        )
    else:
        verdict = verdict_sentence(
            compared.verdict, compared.conclusion, effects, compared.steps, unit
        )
        verdict += _numbers_corrected(compared, stated)
        if judged is not None:
            verdict = f"{verdict} {of_balance(judged, together, scale)}".rstrip()
    return " ".join([*(f"{limit.sentence}." for limit in limits), verdict])


def _numbers_corrected(compared: EffectComparison, stated: StatedIntervals) -> str:
    """What numbers of the model were and are: those of the effects found, or of a sound model."""
    scale = PlantScale.of(compared.fitter.model.model)
    given = {f.name: f for f in compared.fitter.base.free}
    corrected = {e.base_parameter: e for e in compared.effects if e.base_parameter in given}
    moved = {} if compared.verdict != "none" else _moved(compared, stated)
    for name, effect in corrected.items():
        (size,) = effect.parameters()
        by, start = stated.believed[f"{effect.name}.{size}"], given[name].start
        value, low, high = (
            start + x * (1.0 if by.unit else start) for x in (by.value, by.low, by.high)
        )
        moved[name] = Interval(value, low, high, given[name].unit)
    said = []
    for name, now in moved.items():
        unit = f" {scale.unit(now.unit)}".rstrip()
        was = f"{scale.name(name)} was {given[name].start:.5g}{unit}"
        said.append(f"{was} and is {now.value:.4g} [{now.low:.4g}, {now.high:.4g}]{unit}")
    remedy = (
        "calibrate it anew" if corrected else "an effect that acts alike would be hidden in it"
    )
    factors = [now.value / given[name].start for name, now in moved.items() if given[name].start]
    if any(not 1.0 / CONSTANTS.range < factor < CONSTANTS.range for factor in factors):
        # Torques in mN m gave a friction of 19 200 N m s/rad, to be calibrated.
        remedy = "a column in another unit looks like that; check them, else calibrate it anew"
    return f" {'; '.join(said)}: {remedy}." if said else ""


def _moved(compared: EffectComparison, stated: StatedIntervals) -> dict[str, Interval]:
    moved = {}
    for f in compared.fitter.base.free:
        now = stated.believed.get(f.name)
        if now is None or f.owner != BASE or f.start <= 0.0 or now.low <= f.start <= now.high:
            continue
        if abs(now.value / f.start - 1.0) > CONSTANTS.small:
            moved[f.name] = now
    return moved


def _named(effect: type[Effect], believed: Mapping[str, Interval], model: Any) -> NamedEffect:
    keys = {n: f"{effect.name}.{n}" for n in effect.parameters()}
    fitted = {n: believed[key] for n, key in keys.items() if key in believed}
    parameters = {name: in_own_units(effect, name, at, model) for name, at in fitted.items()}
    sentence = effect.sentence({name: at.value for name, at in parameters.items()}, model)
    with_values = effect(**{name: at.value for name, at in fitted.items()})
    return NamedEffect(effect.name, effect.title, parameters, sentence, with_values)


def _errors(step: SearchStep, stage: ModelStage) -> ModelErrors:
    return ModelErrors(step.gap, step.ratio, free_run_rms(stage.fitter, stage.fit))


def _next(compared: EffectComparison, rig: RigDescription | None) -> NextExperiment | None:
    """The experiment that would decide between tied models, or show the error best."""
    plant, models, fitted = compared.fitter.model, compared.models, compared.fitted
    tied = [models.with_effects.get(frozenset({name})) for name in compared.conclusion.tied]
    rivals = {
        fit.effects[0].name: plant.calibrated(fit.values, fit.effects)
        for fit in tied
        if fit is not None
    }
    measurements = compared.fitter.measurements
    evidence = Evidence(measurements, fitted.noise, fitted.where, compared.steps[-1].ratio)
    base = plant.calibrated(compared.start.values)
    return next_experiment(compared.verdict, base, rivals, evidence, rig)


def _live_gains(compared: EffectComparison) -> Gains | None:
    records = compared.fitted.plant.measurements
    stated = [m.gains for m in records if m.loop == "closed" and m.gains is not None]
    return stated[-1] if stated else None


def _recording(compared: EffectComparison) -> NextRecording | None:
    if compared.verdict not in ("ambiguous", "unknown", "incomplete"):
        return None
    model, measurements = compared.fitter.model.model, compared.fitter.measurements
    numbers = [BaseNumbers.of(model, m) for m in measurements]
    return next_recording(measurements, numbers, PlantScale.of(model))


def _calibrations(
    base: CandidateFit, stated: StatedIntervals, scale: PlantScale
) -> tuple[BaseParameter, ...]:
    listed = []
    for free in base.fitted.predictor.free:
        if free.owner == "base" and free.name in stated.base:
            unit = scale.unit(free.unit)
            alone = replace(stated.base[free.name], unit=unit)
            beside = replace(stated.believed.get(free.name, alone), unit=unit)
            listed.append(BaseParameter(scale.name(free.name), unit, free.start, alone, beside))
    return tuple(listed)


def _unexplained(
    last: ModelStage, runs: Sequence[Prediction], noise: NoiseFloor
) -> ResidualLocation:
    model = last.fitter.model.calibrated(last.fit.values)
    records = last.fitter.measurements
    numbers = [BaseNumbers.of(model, m) for m in records]
    simulated = [
        {name: rows[0] for name, rows in run._asdict().items() if rows is not None} for run in runs
    ]
    return localise(records, numbers, noise, simulated)


def _traces(
    before: ModelStage, after: ModelStage, simulated: Sequence[Sequence[Prediction]]
) -> tuple[Trace, ...]:
    """Each record from its start, with no reset on the way, before and after."""
    scale = PlantScale.of(before.fitter.model.model)
    traces = []
    pairs = zip(before.fitter.measurements, after.fitter.measurements, strict=True)
    for n, (m, cleaned) in enumerate(pairs):
        for name in OUTPUTS:
            measured, without_line = m.channel(name), cleaned.channel(name)
            first, last = (getattr(run[n], name) for run in simulated)
            if measured is None or without_line is None or first is None or last is None:
                continue
            # Interference that was taken out belongs to what is predicted with it.
            columns = m.time_s, measured, first[0], last[0] + (measured - without_line)
            title, unit = scale.channel(name)
            traces.append(Trace(m.name, name, unit, *columns, title))
    return tuple(traces)
