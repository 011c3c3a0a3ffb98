"""Puts a diagnosis together from what was found."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from estune.trial import RigDescription
from plants.diagnosis.data.measured_record import DataIssue
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.experiments.next_experiment import Evidence, next_experiment
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.report.plant_units import in_own_units
from plants.diagnosis.residual.localisation import ResidualLocation
from plants.diagnosis.result import Interval, NamedEffect, NextExperiment, SearchStep, Verdict
from plants.diagnosis.search import thresholds
from plants.diagnosis.search.fit import WhitenedFit
from plants.diagnosis.search.model_comparison import explained_fraction
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.rule_based import MainsLine
from plants.diagnosis.search.stepwise import SearchResult
from plants.diagnosis.search.test_error import calibrations, free_run, intervals, reported
from plants.diagnosis.search.verdict import (
    Conclusion,
    candidates,
    not_excited,
    ruled_out,
    verdict_sentence,
)
from plants.effects import Effect, MainsInterference, Quantisation
from plants.effects.plant_scale import written_unit

STEP_KNOWN = 2e-3
"""Relative uncertainty of a step found among readings."""


class EffectChoices(NamedTuple):
    """The effects to choose from.

    Attributes:
        structural: Those that the search tries.
        calibrations: Those that are a wrong number of the model as given.
        by_rule: Those found by a rule of their own.
        unavailable: Why others cannot be had on this model, by slug.
    """

    structural: tuple[type[Effect], ...]
    calibrations: tuple[type[Effect], ...]
    by_rule: tuple[type[Effect], ...]
    unavailable: Mapping[str, str]


class FittedModel(NamedTuple):
    """A model fitted to records."""

    bench: ModelFitter
    attempt: CandidateFit


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosisInputs:
    """All that was found before it is told.

    Attributes:
        model: The model as given.
        humming: The base fit of the records as they are.
        hum: The hum found in them, or None.
        bench: Model and records without hum.
        found: The search.
        judged: Its verdict.
        wrong: The model as given and with the one number changed that is wrong, or None.
        coarse_step_N: Step of a gauge that is read in coarse steps, or None.
        choice: The effects there were to choose from.
        where: Where the residual lives.
        noise: The noise floor.
        findings: What was wrong with the data.
        rig: What the rig allows, where it is at hand.
    """

    model: Any
    humming: FittedModel
    hum: MainsLine | None
    bench: ModelFitter
    found: SearchResult
    judged: Conclusion
    wrong: tuple[CandidateFit, CandidateFit] | None
    coarse_step_N: float | None
    choice: EffectChoices
    where: ResidualLocation
    noise: NoiseFloor
    findings: tuple[DataIssue, ...]
    rig: RigDescription | None = None


class Fit(NamedTuple):
    """A stage fitted once more to all that may be fitted, and the slug it added."""

    bench: ModelFitter
    fitted: WhitenedFit
    added: str | None


def build_diagnosis(known: DiagnosisInputs) -> Diagnosis:
    """The verdict with all its evidence."""
    fits = _fits(known)
    before, after = fits[0], fits[-1]
    first = intervals(before.bench, before.fitted, before.fitted)
    last = intervals(after.bench, after.fitted, before.fitted) if after is not before else first
    base = fits[1] if known.hum is not None else before
    steps = [_step(one) for one in fits]
    effects = _structural(known)
    # In words as of the plant that was fitted: a system of python-control has units only there.
    named = [_named(effect, last, known.bench.model.model) for effect in effects]
    named += _by_rule(known, steps)
    verdict = _verdict(known, named)
    ran = free_run((before.bench, before.fitted), (after.bench, after.fitted))
    listed = candidates(known.found)
    values = after.fitted.predictor.values(after.fitted.values)
    base_values = base.fitted.predictor.values(base.fitted.values)
    plant = known.bench.model
    unit = written_unit(plant.output, plant.model)
    added = [one.effect for one in named]
    values |= {f"{e.name}.{n}": getattr(e, n) for e in added for n in e.parameters()}
    return Diagnosis(
        verdict=verdict,
        sentence=verdict_sentence(verdict, known.judged, named, steps, unit),
        effects=tuple(named),
        ambiguous=known.judged.tied,
        candidates=listed,
        unit=plant.output,
        gap_before=steps[0].gap,
        gap_after=steps[-1].gap,
        floor=steps[0].floor,
        ratio_before=steps[0].ratio,
        ratio_after=steps[-1].ratio,
        closure=explained_fraction(steps[0].ratio ** 2, steps[-1].ratio ** 2)
        if named
        else math.nan,
        rms_before=ran.rms_before,
        rms_after=ran.rms_after,
        noise=known.noise,
        where=known.where,
        calibrations=calibrations(before.fitted.predictor, first, last),
        not_excited={**not_excited(known.found, {}), **known.choice.unavailable},
        ruled_out=ruled_out(listed, [e.name for e in named], known.judged.tied),
        next_experiment=_next(known, verdict, base_values, steps[-1].ratio),
        findings=known.findings,
        steps=tuple(steps),
        traces=ran.traces,
        splits=known.bench.split.parts,
        model=known.model,
        base_model=plant.calibrated(base_values),
        augmented=plant.calibrated(values, [type(effect) for effect in added]),
        values=values,
    )


def _next(
    known: DiagnosisInputs, verdict: Verdict, base_values: Mapping[str, float], ratio_after: float
) -> NextExperiment | None:
    """The experiment that would decide between the models that are tied, or show the gap best."""
    if verdict not in ("ambiguous", "unknown"):
        return None
    plant, rounds = known.bench.model, known.found.rounds
    rivals = {
        a.effects[-1].name: plant.calibrated(a.values, a.effects)
        for a in (rounds[0].attempts if rounds else ())
        if a.effects[-1].name in known.judged.tied
    }
    evidence = Evidence(known.bench.measurements, known.noise, known.where, ratio_after)
    return next_experiment(verdict, plant.calibrated(base_values), rivals, evidence, known.rig)


def _fits(known: DiagnosisInputs) -> list[Fit]:
    """The models from the base to what is believed, one effect more each."""
    bench = known.bench
    if known.wrong is not None:
        return [
            Fit(bench, bench.final(known.wrong[0]), None),
            Fit(bench, bench.final(known.wrong[1]), known.wrong[1].effects[0].name),
        ]
    fits = []
    if known.hum is not None:
        at = known.humming
        fits.append(Fit(at.bench, at.bench.final(at.attempt), None))
    added = None if known.hum is None else MainsInterference.name
    fits.append(Fit(bench, bench.final(known.found.base), added))
    believed = known.found.stages if known.judged.best.effects else ()
    return [*fits, *(Fit(bench, bench.final(a), a.effects[-1].name) for a in believed)]


def _step(one: Fit) -> SearchStep:
    found = reported(one.bench, one.fitted)
    return SearchStep(one.added, found.gap, found.floor, found.ratio)


def _structural(known: DiagnosisInputs) -> tuple[type[Effect], ...]:
    return known.wrong[1].effects if known.wrong is not None else known.judged.best.effects


def _named(effect: type[Effect], found: Mapping[str, Interval], model: Any) -> NamedEffect:
    return _told_by({n: found[f"{effect.name}.{n}"] for n in effect.parameters()}, effect, model)


def _told_by(parameters: Mapping[str, Interval], effect: type[Effect], model: Any) -> NamedEffect:
    own = {name: in_own_units(effect, name, one, model) for name, one in parameters.items()}
    said = effect.sentence({name: one.value for name, one in own.items()}, model)
    built = effect(**{name: one.value for name, one in parameters.items()})
    return NamedEffect(effect.name, effect.title, own, said, built)


def _by_rule(known: DiagnosisInputs, steps: list[SearchStep]) -> list[NamedEffect]:
    """The effects found by rule; what coarse steps explain is taken off the gap."""
    named, plant = [], known.bench.model
    read = abs(plant.reading_unit)  # a phase differs from record to record, with its sign
    if known.hum is not None:
        parameters = {
            "amplitude_N": known.hum.amplitude_N.over(read),
            "frequency_Hz": known.hum.frequency_Hz,
            "phase_rad": known.hum.phase_rad,
        }
        named.append(_told_by(parameters, MainsInterference, plant.model))
    if known.coarse_step_N is not None:
        q = known.coarse_step_N
        unrounded = _without_rounding(steps, q)
        left = _rounded(unrounded[-1], q)
        if _counts(unrounded[-1], left):
            # Readings are written with few digits, of which the step has as many.
            step = Interval(q, q * (1.0 - STEP_KNOWN), q * (1.0 + STEP_KNOWN), "N")
            named.append(_told_by({"step_N": step.over(read)}, Quantisation, plant.model))
            steps[:] = [*unrounded, left]
    return named


def _counts(before: SearchStep, after: SearchStep) -> bool:
    """Whether rounding is much beside all else that is allowed for, and beside what is missing."""
    closes = explained_fraction(before.ratio**2, after.ratio**2)
    return before.ratio > thresholds.NOTHING and closes >= thresholds.FURTHER


def _without_rounding(steps: Sequence[SearchStep], step_N: float) -> list[SearchStep]:
    """The steps against a floor without rounding."""
    rounding, again = step_N**2 / 12.0, []
    for one in steps:
        floor = math.sqrt(max(one.floor**2 - rounding, 0.01 * one.floor**2))
        again.append(SearchStep(one.effect, one.gap, floor, one.gap / floor))
    return again


def _rounded(last: SearchStep, step_N: float) -> SearchStep:
    """What rounding leaves of the last step's gap."""
    rounding = step_N**2 / 12.0
    gap = math.sqrt(max(last.gap**2 - rounding, last.floor**2))
    return SearchStep(Quantisation.name, gap, last.floor, gap / last.floor)


def _verdict(known: DiagnosisInputs, named: Sequence[NamedEffect]) -> Verdict:
    """What the search says, with what was found besides."""
    verdict = known.judged.verdict
    if verdict == "none" and named:
        return "named"
    if verdict == "unknown" and named:
        return "incomplete"
    return verdict
