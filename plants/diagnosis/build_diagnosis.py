"""Assembly of a diagnosis from the results of its parts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from estune.recordings.issue import DataIssue
from estune.trial import RigDescription
from plants.diagnosis.data.measured_record import OUTPUTS
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.declared_effects import declared_effects
from plants.diagnosis.experiments.next_experiment import Evidence, next_experiment
from plants.diagnosis.hold_out import (
    floor_of,
    free_run_rms,
    held_errors,
    hold_out,
    moved_rms,
)
from plants.diagnosis.interval import Interval
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.report.plant_units import in_own_units, located_in_own_units
from plants.diagnosis.residual.localisation import ResidualLocation
from plants.diagnosis.residual.torque_waves import TorqueWaves
from plants.diagnosis.result import (
    BaseParameter,
    ModelErrors,
    NamedEffect,
    NextExperiment,
    SearchStep,
    Trace,
    Verdict,
    explained_share,
)
from plants.diagnosis.search.conclusion import (
    Conclusion,
    candidates,
    not_excited,
    verdict_sentence,
)
from plants.diagnosis.search.constants import CONSTANTS
from plants.diagnosis.search.intervals import intervals
from plants.diagnosis.search.limitations import limitations, most_refused
from plants.diagnosis.search.mains_interference import MainsLine
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.search import SearchResult
from plants.diagnosis.search.validation import held_out, segments
from plants.effects import Cogging, Effect, MainsInterference, Quantisation
from plants.effects.plant_scale import PlantScale, si, written_unit

STEP_KNOWN = 2e-3
"""Relative uncertainty of a step found among readings."""


class EffectChoices(NamedTuple):
    """The effects to choose from.

    Attributes:
        structural: Those that the search fits.
        calibrations: Those that are a wrong number of the model as given.
        in_noise: Those found in the noise.
        in_torque: Those found in the balance of torques.
        unavailable: Why others cannot be added to this model, by slug.
        shown_by: The experiment that shows each of all, by slug.
    """

    structural: tuple[type[Effect], ...]
    calibrations: tuple[type[Effect], ...]
    in_noise: tuple[type[Effect], ...]
    in_torque: tuple[type[Effect], ...]
    unavailable: Mapping[str, str]
    shown_by: Mapping[str, str]


class FittedModel(NamedTuple):
    """A candidate fit beside the fitter that can repeat it."""

    fitter: ModelFitter
    fit: CandidateFit


class ModelSearch(NamedTuple):
    """A variant of the model with its search: where the residual is, the fits, the conclusion."""

    fitter: ModelFitter
    where: ResidualLocation
    found: SearchResult
    judged: Conclusion


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosisInputs:
    """Results of all parts of a diagnosis.

    Attributes:
        model: The model as given.
        recorded: The base fit of the records as they are, interference included.
        line: The mains interference found in them, or None.
        done: The search on records without interference.
        wrong: The model as given with the one number changed that is wrong, or None.
        coarse_step_N: Step of a gauge that is read in coarse steps, or None.
        held: The model as given for records held out of the fits, or None.
        waves: Waves over the angle that explain the current where the search explains nothing.
    """

    model: Any
    recorded: FittedModel
    line: MainsLine | None
    done: ModelSearch
    wrong: CandidateFit | None
    coarse_step_N: float | None
    choice: EffectChoices
    noise: NoiseFloor
    findings: tuple[DataIssue, ...]
    rig: RigDescription | None = None
    held: DiagnosedModel | None = None
    waves: TorqueWaves | None = None


class ModelStage(NamedTuple):
    """A model on the way to the one that is believed.

    Attributes:
        fitter: Model and records.
        fit: Its fit.
        step: What it added, and its prediction error on data left out.
    """

    fitter: ModelFitter
    fit: CandidateFit
    step: SearchStep


def build_diagnosis(inputs: DiagnosisInputs) -> Diagnosis:
    """The verdict with all its evidence."""
    stages, judged = _evidenced(inputs, *_validated(inputs, inputs.done.judged))
    before, after = stages[0], stages[-1]
    judged = _not_nothing(inputs, judged, after)
    first = intervals(before.fitter, before.fit, before.fit)
    last = intervals(after.fitter, after.fit, before.fit) if after is not before else first
    steps = [one.step for one in stages]
    # In words as of the plant that was fitted: a system of python-control has units only there.
    plant = inputs.done.fitter.model
    effects = [e for e in _in_order(stages) if e is not MainsInterference]
    named = [
        _named(e, {n: last[f"{e.name}.{n}"] for n in e.parameters()}, plant.model) for e in effects
    ]
    named += _in_noise(inputs, steps)
    if inputs.waves is not None:
        named.append(_named(Cogging, inputs.waves.parameters, plant.model))
    verdict = _verdict(inputs, judged, named)
    unit = written_unit(plant.output, plant.model)
    base = inputs.done.found.base if inputs.wrong is None else inputs.done.found.given
    # Base numbers that were fitted without the waves have bent to make up for them.
    believed = after.fit if inputs.waves is None else inputs.done.found.given
    values = believed.values
    if inputs.waves is not None:
        values["torque_offset_Nm"] = inputs.waves.offset_Nm
    added = [one.effect for one in named]
    values |= {f"{e.name}.{n}": getattr(e, n) for e in added for n in e.parameters()}
    listed = candidates(inputs.done.found, judged)
    scale = PlantScale.of(plant.model)
    limits = limitations(inputs.done.fitter.measurements, inputs.findings, believed, scale)
    said = verdict_sentence(verdict, judged, named, steps, unit)
    if inputs.waves is not None:
        said = f"{named[-1].sentence} {inputs.waves.sentence}"
    held = None if inputs.held is None else hold_out(inputs.held, before.fit, after.fit)
    return Diagnosis(
        verdict=verdict,
        sentence=" ".join([*(f"{one.sentence}." for one in limits), said]),
        effects=tuple(named),
        ambiguous=judged.tied if verdict == "ambiguous" else (),
        candidates=listed,
        unit=scale.unit(plant.output),
        given=held_errors(before.fitter, before.fitter.given()),
        before=_errors(steps[0], before),
        after=_errors(steps[-1], after),
        floor=steps[0].floor,
        noise=inputs.noise,
        where=located_in_own_units(inputs.done.where, scale),
        calibrations=_calibrations(before.fit, first, last, scale),
        not_excited={**not_excited(inputs.done.found), **inputs.choice.unavailable},
        next_experiment=_next(inputs, judged, verdict, base, steps[-1].ratio),
        findings=inputs.findings,
        steps=tuple(steps),
        traces=_traces(before, after),
        splits=segments(inputs.done.fitter),
        model=inputs.model,
        base_model=plant.calibrated(base.values),
        augmented=plant.calibrated(values, [type(effect) for effect in added]),
        values=values,
        declared=declared_effects(plant, inputs.noise, base, first),
        hold_out=held,
        limitations=limits,
        models=judged.models,
        shown_by=inputs.choice.shown_by,
    )


def _evidenced(
    inputs: DiagnosisInputs, stages: list[ModelStage], judged: Conclusion
) -> tuple[list[ModelStage], Conclusion]:
    """Without the one of two effects whose size may as well be that at which it does nothing."""
    base, last = stages[0], stages[-1]
    if len(last.fit.effects) < 2:
        return stages, judged
    stated = intervals(last.fitter, last.fit, base.fit)
    idle = [effect for effect in last.fit.effects if _may_be_nothing(effect, stated)]
    rest = [effect for effect in last.fit.effects if effect not in idle]
    alone = inputs.done.found.fits.get(frozenset(effect.name for effect in rest))
    if len(idle) != 1 or alone is None:
        return stages, judged
    verdict: Verdict = "named" if CONSTANTS.incomplete >= alone.J else "incomplete"
    single = judged._replace(verdict=verdict, stages=(inputs.done.found.base, alone), tied=())
    return _validated(inputs, single)


def _may_be_nothing(effect: type[Effect], stated: Mapping[str, Interval]) -> bool:
    """Whether the intervals of all sizes of an effect hold the value at which it does nothing."""
    sizes = {name: p.neutral for name, p in effect.parameters().items() if p.neutral is not None}
    held = (stated[f"{effect.name}.{name}"] for name in sizes)
    return all(one.low <= at <= one.high for one, at in zip(held, sizes.values(), strict=True))


def _validated(inputs: DiagnosisInputs, judged: Conclusion) -> tuple[list[ModelStage], Conclusion]:
    """The models from the base to what is believed; unknown where data left out do not agree."""
    fitter = inputs.done.fitter
    stages: list[ModelStage] = []
    if inputs.line is not None:
        stages.append(_stage(*inputs.recorded, None))
    fits = judged.stages if inputs.wrong is None else (inputs.done.found.given, inputs.wrong)
    fits = tuple(map(fitter.final, fits))
    there: frozenset[str] = frozenset()
    for one in fits:
        added = next(iter(sorted(one.names - there)), None)
        if one is fits[0] and inputs.line is not None:
            added = MainsInterference.name
        stages.append(_stage(fitter, one, added))
        there = one.names
    base, last = stages[len(stages) - len(fits)], stages[-1]
    share = explained_share(base.step.ratio, last.step.ratio)
    agrees = share >= CONSTANTS.named_share or last.step.ratio**2 <= CONSTANTS.floor
    if len(fits) > 1 and inputs.wrong is None and not agrees:
        reason = (
            f"{' and '.join(e.title for e in judged.best.effects)} would explain it, but on "
            f"data left out only {100.0 * max(share, 0.0):.0f} % of it."
        )
        unknown = judged._replace(
            verdict="unknown", stages=fits[:1], tied=(), rest="", reason=reason
        )
        return stages[: len(stages) - len(fits) + 1], unknown
    return stages, judged


def _not_nothing(inputs: DiagnosisInputs, judged: Conclusion, last: ModelStage) -> Conclusion:
    """Unknown where short predictions are within the noise, but something else is far off."""
    if judged.verdict != "none":
        return judged
    contradictions = []
    worst = max(inputs.done.where.blocks, key=lambda block: block.ratio, default=None)
    # The balances are of the linear model: effects that the model has are left in them.
    linear = not inputs.done.fitter.model.effects
    if worst is not None and linear and worst.ratio**2 > CONSTANTS.incomplete:
        contradictions.append(f"the {worst.title} is at {worst.ratio:.2g} times its noise")
    apart, moved = free_run_rms(last.fitter, last.fit), moved_rms(last.fitter)
    if apart > CONSTANTS.free_run * moved:
        unit = written_unit(last.fitter.model.output, last.fitter.model.model)
        contradictions.append(
            f"a free run is {si(apart, unit)} off, of a motion of {si(moved, unit)}"
        )
    if not contradictions:
        return judged
    reason = (
        "Short predictions are within the noise floor, which may be too high, but "
        f"{' and '.join(contradictions)}."
    )
    return judged._replace(verdict="unknown", reason=reason)


def _stage(fitter: ModelFitter, one: CandidateFit, added: str | None) -> ModelStage:
    ratio, floor = float(np.sqrt(np.mean(held_out(fitter, one) ** 2))), floor_of(fitter)
    return ModelStage(fitter, one, SearchStep(added, ratio * floor, floor, ratio))


def _in_order(stages: Sequence[ModelStage]) -> list[type[Effect]]:
    """The effects of the last stage in the order in which they were added."""
    order = [one.step.effect for one in stages]
    return sorted(
        stages[-1].fit.effects,
        key=lambda e: order.index(e.name) if e.name in order else len(order),
    )


def _errors(step: SearchStep, one: ModelStage) -> ModelErrors:
    """Errors of a model: on data left out, and in free run."""
    return ModelErrors(step.gap, step.ratio, free_run_rms(one.fitter, one.fit))


def _verdict(inputs: DiagnosisInputs, judged: Conclusion, named: Sequence[NamedEffect]) -> Verdict:
    """The conclusion, with what was found in the noise besides."""
    verdict = judged.verdict
    if verdict == "none" and most_refused(inputs.done.fitter.measurements, inputs.findings):
        verdict = "unknown"
    if named and verdict in ("none", "unknown"):
        return "named" if verdict == "none" else "incomplete"
    return verdict


def _next(
    inputs: DiagnosisInputs,
    judged: Conclusion,
    verdict: Verdict,
    base: CandidateFit,
    ratio_after: float,
) -> NextExperiment | None:
    """The experiment that would decide between tied models, or show the error best."""
    plant = inputs.done.fitter.model
    singles = (inputs.done.found.fits.get(frozenset({name})) for name in judged.tied)
    rivals = {
        one.effects[0].name: plant.calibrated(one.values, one.effects)
        for one in singles
        if one is not None
    }
    measurements = inputs.done.fitter.measurements
    evidence = Evidence(measurements, inputs.noise, inputs.done.where, ratio_after)
    return next_experiment(verdict, plant.calibrated(base.values), rivals, evidence, inputs.rig)


def _named(effect: type[Effect], fitted: Mapping[str, Interval], model: Any) -> NamedEffect:
    """An effect by its fitted values, in its own names."""
    own = {name: in_own_units(effect, name, one, model) for name, one in fitted.items()}
    said = effect.sentence({name: one.value for name, one in own.items()}, model)
    built = effect(**{name: one.value for name, one in fitted.items()})
    return NamedEffect(effect.name, effect.title, own, said, built)


def _in_noise(inputs: DiagnosisInputs, steps: list[SearchStep]) -> list[NamedEffect]:
    """The effects found in the noise; what coarse steps explain is taken off the error."""
    named, plant, line = [], inputs.done.fitter.model, inputs.line
    read = abs(plant.reading_unit)  # a phase differs from record to record, with its sign
    if line is not None:
        parameters = {
            "amplitude_N": line.amplitude_N.over(read),
            "frequency_Hz": line.frequency_Hz,
            "phase_rad": line.phase_rad,
        }
        named.append(_named(MainsInterference, parameters, plant.model))
    if inputs.coarse_step_N is not None:
        q = inputs.coarse_step_N
        unrounded = [_without_rounding(one, q**2 / 12.0) for one in steps]
        left = _rounded(unrounded[-1], q**2 / 12.0)
        above = unrounded[-1].ratio ** 2 > CONSTANTS.floor
        if above and explained_share(unrounded[-1].ratio, left.ratio) >= CONSTANTS.one_more:
            # Readings are written with few digits, of which the step has as many.
            step = Interval(q, q * (1.0 - STEP_KNOWN), q * (1.0 + STEP_KNOWN), "N")
            named.append(_named(Quantisation, {"step_N": step.over(read)}, plant.model))
            steps[:] = [*unrounded, left]
    return named


def _without_rounding(one: SearchStep, rounding: float) -> SearchStep:
    """A step of the search against a noise floor without the power of rounding."""
    floor = math.sqrt(max(one.floor**2 - rounding, 0.01 * one.floor**2))
    return replace(one, floor=floor, ratio=one.gap / floor)


def _rounded(last: SearchStep, rounding: float) -> SearchStep:
    """The last step's error without the power of rounding."""
    gap = math.sqrt(max(last.gap**2 - rounding, last.floor**2))
    return SearchStep(Quantisation.name, gap, last.floor, gap / last.floor)


def _calibrations(
    base: CandidateFit,
    first: Mapping[str, Interval],
    last: Mapping[str, Interval],
    scale: PlantScale,
) -> tuple[BaseParameter, ...]:
    """The base model's numbers as given, as fitted, and as fitted with the effects."""
    found = []
    for f in base.fitted.predictor.free:
        if f.owner == "base" and f.name in first:
            unit = scale.unit(f.unit)
            alone = replace(first[f.name], unit=unit)
            beside = replace(last.get(f.name, alone), unit=unit)
            found.append(BaseParameter(scale.name(f.name), unit, f.start, alone, beside))
    return tuple(found)


def _traces(before: ModelStage, after: ModelStage) -> tuple[Trace, ...]:
    """Each record from its start with nothing put right on the way, before and after."""
    runs = [one.fitter.free_run(one.fit) for one in (before, after)]
    scale = PlantScale.of(before.fitter.model.model)
    traces = []
    pairs = zip(before.fitter.measurements, after.fitter.measurements, strict=True)
    for n, (m, cleaned) in enumerate(pairs):
        for name in OUTPUTS:
            measured, rest = m.channel(name), cleaned.channel(name)
            first, last = (getattr(run[n], name) for run in runs)
            if measured is None or rest is None or first is None or last is None:
                continue
            # What was taken out as interference belongs to what is predicted with it.
            values = m.time_s, measured, first[0], last[0] + (measured - rest)
            title, unit = scale.channel(name)
            traces.append(Trace(m.name, name, unit, *values, title))
    return tuple(traces)
