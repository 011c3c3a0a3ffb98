"""Step 6: models with effects are fitted, one is believed, and its verdict is tested.

Single effects, and pairs with the best of them, are fitted. The model that is believed takes off
enough of the error; it is fitted to all records, has to predict data left out, and no other figure
may contradict a `none`. Effects that are no law of motion are looked for beside: one wrong number
of the model as given, coarse readings, and waves in the torque over the angle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.records import FolderContents
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.pipeline.balance import disputed, judgement, with_values
from plants.diagnosis.pipeline.fit import BaseFit
from plants.diagnosis.progress import Progress, portion
from plants.diagnosis.residual.localisation import ResidualLocation
from plants.diagnosis.residual.torque_waves import TorqueWaves, torque_waves
from plants.diagnosis.result import SearchStep, Slugs, Verdict, explained_share, family_of
from plants.diagnosis.search.conclusion import Conclusion, conclude
from plants.diagnosis.search.fitted_models import FittedModels, summarise
from plants.diagnosis.search.limitations import most_refused
from plants.diagnosis.search.mains_interference import MainsLine
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.more_records import AllRecords, on_all_records
from plants.diagnosis.search.screening import Screening
from plants.diagnosis.search.search import search
from plants.diagnosis.search.validation import ModelStage, free_run_rms, moved_rms, stage
from plants.diagnosis.search.wrong_parameter import find_wrong_parameter, settle_calibrations
from plants.diagnosis.torque_balance.agreement import (
    SILENT,
    VISIBLE,
    Agreement,
    agreement,
)
from plants.diagnosis.torque_balance.judge import TorqueJudgement
from plants.diagnosis.torque_balance.laws import CHANGING
from plants.effects import Cogging, Effect, MainsInterference, Quantisation
from plants.effects.plant_scale import PlantScale, si, written_unit


@dataclass(frozen=True, slots=True, eq=False)
class EffectComparison:
    """The model that is believed, and the evidence for it.

    Attributes:
        models: All models, fitted to the records without interference.
        stages: The models from the base to the one believed, each with its error on data left out;
            the first is of the records with interference, where there is some.
        steps: Those errors, with the noise of coarse readings as a step of its own.
        effects: The effects believed, in the order in which they were added.
        waves: The waves over the angle in the torque, or None.
        judged: What the balance of torques says, or None where it says nothing.
        together: How that stands to what the prediction says.
    """

    fitted: BaseFit
    screening: Screening
    verdict: Verdict
    conclusion: Conclusion
    models: FittedModels
    stages: tuple[ModelStage, ...]
    steps: tuple[SearchStep, ...]
    effects: tuple[type[Effect], ...]
    line: MainsLine | None
    waves: TorqueWaves | None
    judged: TorqueJudgement | None = None
    together: Agreement = SILENT

    @property
    def fitter(self) -> ModelFitter:
        """The model with all records, without interference."""
        return self.stages[-1].fitter

    @property
    def start(self) -> CandidateFit:
        """The model that effects were added to: as given where one of its numbers is wrong."""
        is_number = any(e.base_parameter for e in self.stages[-1].fit.effects)
        return self.models.given if is_number else self.models.base


def compare(
    usable: FolderContents,
    fitted: BaseFit,
    screening: Screening,
    held_out: Sequence[MeasuredRecord],
    progress: Progress,
) -> EffectComparison:
    """The model that the records support."""
    choices, coarse_step_N = fitted.choices, fitted.noise.coarse_step_N
    models = search(
        fitted.fitter, fitted.models, screening, fitted.scale, portion(progress, 0.0, 0.9)
    )
    searched = conclude(fitted.fitter, models)
    progress("confirming on all records", 0.9)
    every = on_all_records(fitted.plant, fitted.fitter, models, searched, fitted.line)
    conclusion = conclude(every.fitter, every.models) if every.refitted else searched
    wrong = None
    if conclusion.verdict == "none" and every.line is None:
        wrong = find_wrong_parameter(every.fitter, every.models, choices.calibrations)
        if wrong is None:
            settled = settle_calibrations(every.fitter, every.models, choices.calibrations)
            if settled.effects:
                wrong = settled
            else:
                every = every._replace(models=replace(every.models, base=settled))
                conclusion = conclusion._replace(stages=(settled,))
    progress("refitting with parts left out", 0.95)
    stages = _stages(every, conclusion.stages if wrong is None else (every.models.given, wrong))
    if wrong is None:
        conclusion, stages = _cross_validated(conclusion, stages)
    conclusion = _not_contradicted(conclusion, stages[-1], fitted.where)
    steps = tuple(each.step for each in stages)
    if Quantisation in choices.in_noise and coarse_step_N is not None:
        steps = _with_rounding(steps, coarse_step_N)
    waves = None
    if Cogging in choices.in_torque and conclusion.verdict in ("unknown", "none"):
        waves = _waves(fitted, held_out)
    judged = judgement(fitted, held_out) if waves is None else None
    together = SILENT
    if wrong is None and judged is not None:
        predicted = stages
        conclusion, stages = _undisputed(conclusion, stages, every.models, fitted, judged)
        believed = stages[-1].fit.effects
        foreseen = conclusion.leading | _predicting(every.models, judged)
        left_open = conclusion.tied or _fuller(every.models, stages[-1])
        together = agreement(conclusion.verdict, believed, left_open, foreseen, judged)
        conclusion, stages = _weighed(conclusion, stages, every.models, judged, together)
        steps = steps if stages is predicted else tuple(each.step for each in stages)
    effects = _effects(stages, every.line, steps, waves)
    too_few = most_refused(usable.measurements, usable.findings)
    return EffectComparison(
        fitted=fitted,
        screening=screening,
        verdict=_verdict(conclusion.verdict, effects, waves, too_few=too_few),
        conclusion=conclusion,
        models=every.models,
        stages=stages,
        steps=steps,
        effects=effects,
        line=every.line,
        waves=waves,
        judged=judged,
        together=together,
    )


def _predicting(models: FittedModels, judged: TorqueJudgement) -> Slugs:
    """The law of a torque, beside those that are certain, that predicts the motion best alone."""
    certain = {e.name for e in judged.effects[:-1]}
    laws = [fit for fit in models.singles if family_of(fit.effects[0]) in VISIBLE]
    return next((fit.names for fit in laws if not fit.names & certain), frozenset())


def _fuller(models: FittedModels, last: ModelStage) -> tuple[str, ...]:
    """Slugs of fuller laws of the one that is believed, of a fit that leaves no more.

    Of its own a prediction takes the simpler one of two that explain about as much.
    """
    if len(last.fit.effects) != 1:
        return ()
    (simpler,) = last.fit.effects
    return tuple(
        fit.effects[0].name
        for fit in models.singles
        if family_of(fit.effects[0]) == family_of(simpler)
        and len(fit.effects[0].parameters()) > len(simpler.parameters())
        and last.fit.J >= fit.J
        and summarise(fit, last.fitter.scale).eligible
    )


def _undisputed(
    conclusion: Conclusion,
    stages: tuple[ModelStage, ...],
    models: FittedModels,
    fitted: BaseFit,
    judged: TorqueJudgement,
) -> tuple[Conclusion, tuple[ModelStage, ...]]:
    last = stages[-1]
    wrong = disputed(fitted, judged, last.fit)
    if not wrong and (judged.changes_Nm is None or conclusion.verdict != "unknown"):
        return conclusion, stages
    titles = " and ".join(effect.title for effect in last.fit.effects)
    like = ""
    if judged.changes_Nm is not None:
        scale = PlantScale.of(fitted.plant.model)
        low, high = (scale.torque(max(size, 0.0)) for size in judged.changes_Nm)
        like = f"{CHANGING.title}, {low} to {high} in the course of a record"
    rest = frozenset(e.name for e in last.fit.effects if e not in wrong)
    if not rest:
        would = f"The prediction of the motion would name {titles}; with it torques balance worse."
        return conclusion.unknown("" if like else would)._replace(like=like), stages[:1]
    fit = models.with_effects.get(rest) or _without(last, rest)
    kept = stage(last.fitter, last.fitter.final(fit), next(iter(sorted(rest))))
    complete = kept.step.ratio <= CONSTANTS.above_noise
    verdict: Verdict = "named" if complete else "incomplete"
    conclusion = conclusion._replace(
        verdict=verdict, stages=(models.base, fit), tied=(), rest=like
    )
    return conclusion, (*stages[:1], kept)


def _without(last: ModelStage, rest: Slugs) -> CandidateFit:
    effects = tuple(e for e in last.fit.effects if e.name in rest)
    free = {f.name for f in last.fitter.predictor(effects).free}
    values = {name: value for name, value in last.fit.values.items() if name in free}
    return last.fitter.fit(effects, last.fitter.predictor(effects).row(values))


def _weighed(
    conclusion: Conclusion,
    stages: tuple[ModelStage, ...],
    models: FittedModels,
    judged: TorqueJudgement,
    together: Agreement,
) -> tuple[Conclusion, tuple[ModelStage, ...]]:
    last = stages[-1]
    if together.weight == "tie":
        fit = models.with_effects[frozenset({together.effects[0].name})]
        decided = stage(last.fitter, last.fitter.final(fit), together.effects[0].name)
        stages = (*stages[:1], decided)
        complete = decided.step.ratio <= CONSTANTS.above_noise
        conclusion = conclusion._replace(verdict="named" if complete else "incomplete", tied=())
    elif together.weight == "balance":
        sized = bool(together.shared)
        fit = with_values(last.fitter, together.effects, judged, sized=sized)
        stages = (*stages[:1], stage(last.fitter, fit, together.effects[0].name))
        complete = judged.is_complete and stages[-1].step.ratio <= CONSTANTS.above_noise
        verdict: Verdict = "named" if complete else "incomplete"
        conclusion = conclusion._replace(
            verdict=verdict, stages=(models.base, fit), rest=judged.like, reason=""
        )
    elif together.weight == "contradiction":
        titles = " and ".join(effect.title for effect in last.fit.effects)
        conclusion = conclusion.unknown(f"The prediction of the motion would name {titles}.")
        stages = stages[:1]
    return conclusion, stages


def _stages(every: AllRecords, fits: Sequence[CandidateFit]) -> tuple[ModelStage, ...]:
    stages = []
    if every.recorded is not None:
        stages.append(stage(*every.recorded, None))
    before: frozenset[str] = frozenset()
    for n, fit in enumerate(fits):
        added = next(iter(sorted(fit.names - before)), None)
        if n == 0 and every.line is not None:
            added = MainsInterference.name
        stages.append(stage(every.fitter, every.fitter.final(fit), added))
        before = fit.names
    return tuple(stages)


def _cross_validated(
    conclusion: Conclusion, stages: tuple[ModelStage, ...]
) -> tuple[Conclusion, tuple[ModelStage, ...]]:
    """Unknown where a model does not explain as much of data left out as of all."""
    last = stages[-1]
    if not last.fit.effects:
        return conclusion, stages
    n = next(n for n, each in enumerate(stages) if each.fitter is last.fitter)
    share = explained_share(stages[n].step.ratio ** 2, last.step.ratio**2)
    if share >= CONSTANTS.named_share or last.step.ratio**2 <= CONSTANTS.floor:
        return conclusion, stages
    titles = " and ".join(effect.title for effect in last.fit.effects)
    reason = (
        f"{titles} explains it where all data are fitted, but only "
        f"{100.0 * max(share, 0.0):.0f} % of it on data left out."
    )
    return conclusion.unknown(reason), stages[: n + 1]


def _not_contradicted(
    conclusion: Conclusion, last: ModelStage, where: ResidualLocation
) -> Conclusion:
    """Unknown where short predictions are within the noise, but a balance or free run is not."""
    if conclusion.verdict != "none":
        return conclusion
    model = last.fitter.model
    # The balance of the whole motion; others are of a cable without sag, of a drive without lag.
    contradictions = [
        f"the {block.title} is at {block.ratio:.2g} times its noise"
        for block in where.blocks
        if block.name in ("force", "plant")
        and model.is_linear
        and block.ratio > CONSTANTS.above_noise
    ]
    error, motion = free_run_rms(last.fitter, last.fit), moved_rms(last.fitter)
    if error > CONSTANTS.free_run * motion:
        unit = written_unit(model.output, model.model)
        contradictions.append(
            f"the error of a free run is {si(error, unit)}, of a motion of {si(motion, unit)}"
        )
    if not contradictions:
        return conclusion
    return conclusion.unknown(
        "Short predictions are within the noise floor, which may be too high, but "
        f"{' and '.join(contradictions)}."
    )


def _with_rounding(steps: tuple[SearchStep, ...], step_N: float) -> tuple[SearchStep, ...]:
    """Errors against a floor without rounding, and what rounding explains as a last step.

    The same errors where rounding explains too little of them.
    """
    power = step_N**2 / 12.0
    floors = [math.sqrt(max(s.floor**2 - power, 0.01 * s.floor**2)) for s in steps]
    unrounded = [
        replace(s, floor=floor, ratio=s.gap / floor)
        for s, floor in zip(steps, floors, strict=True)
    ]
    last = unrounded[-1]
    gap = math.sqrt(max(last.gap**2 - power, last.floor**2))
    rounded = SearchStep(Quantisation.name, gap, last.floor, gap / last.floor)
    explains = explained_share(last.ratio**2, rounded.ratio**2) >= CONSTANTS.one_more
    return (*unrounded, rounded) if last.ratio**2 > CONSTANTS.floor and explains else steps


def _waves(fitted: BaseFit, held_out: Sequence[MeasuredRecord]) -> TorqueWaves | None:
    plant, noise = fitted.plant, fitted.noise.channels.get("current_A")
    numbers = [BaseNumbers.of(plant.model, m) for m in plant.measurements]
    if noise is None:
        return None
    waves = torque_waves(plant.measurements, numbers, noise.rms, held_out)
    return waves if waves is not None and waves.share >= CONSTANTS.named_share else None


def _effects(
    stages: Sequence[ModelStage],
    line: MainsLine | None,
    steps: Sequence[SearchStep],
    waves: TorqueWaves | None,
) -> tuple[type[Effect], ...]:
    """The effects of the last stage in the order in which they were added, then those beside."""
    order = [each.step.effect for each in stages]
    fitted = sorted(
        stages[-1].fit.effects,
        key=lambda e: order.index(e.name) if e.name in order else len(order),
    )
    beside = (
        (MainsInterference, line is not None),
        (Quantisation, steps[-1].effect == Quantisation.name),
        (Cogging, waves is not None),
    )
    return (*fitted, *(effect for effect, is_there in beside if is_there))


def _verdict(
    concluded: Verdict,
    effects: Sequence[type[Effect]],
    waves: TorqueWaves | None,
    *,
    too_few: bool,
) -> Verdict:
    """The conclusion of the search, with what was found beside it.

    Waves over the angle are judged by the current that they leave, as any model by its residual.
    """
    verdict: Verdict = "unknown" if concluded == "none" and too_few else concluded
    if waves is not None:
        complete = waves.after_A <= CONSTANTS.above_noise * waves.noise_A
        return "named" if complete else "incomplete"
    if effects and verdict == "none":
        return "named"
    return "incomplete" if effects and verdict == "unknown" else verdict
