"""Searches on a few of many records, and fits carried over from some records to others."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.search.conclusion import Conclusion
from plants.diagnosis.search.fitted_models import FittedModels
from plants.diagnosis.search.mains_interference import MainsLine, line_in_residual
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter


def differing(measurements: Sequence[MeasuredRecord]) -> tuple[MeasuredRecord, ...]:
    """Records that differ the most in gains, profile and operating point, no more than are needed.

    Each is the one farthest from those taken before (Gonzalez 1985), the first the one that moves
    the most. All of them where there are not many samples.
    """
    if sum(m.samples for m in measurements) <= CONSTANTS.searched:
        return tuple(measurements)
    properties = _properties(measurements)
    taken = [int(properties[:, 0].argmax())]
    distance = np.full(len(properties), np.inf)
    while True:
        to_last = np.linalg.norm(properties - properties[taken[-1]], axis=1)
        distance = np.minimum(distance, to_last)
        distance[taken] = -1.0
        farthest = int(distance.argmax())
        if sum(measurements[n].samples for n in (*taken, farthest)) > CONSTANTS.searched:
            return tuple(measurements[n] for n in sorted(taken))
        taken.append(farthest)


def _properties(measurements: Sequence[MeasuredRecord]) -> FloatArray:
    """Motion, operating point, gains and profile of each, in standard deviations."""
    kinds = sorted({(m.loop, m.profile) for m in measurements})
    rows = []
    for m in measurements:
        moved = next(np.asarray(m.channel(name)) for name in (*m.outputs, "current_A"))
        gains = (0.0, 0.0, 0.0, 0.0)
        if m.gains is not None:
            gains = (m.gains.P, m.gains.I, m.gains.D, m.gains.setpoint_filter_s)
        operating = (float(np.nanstd(moved)), m.preload_N, m.cable_length_m or 0.0, *gains)
        rows.append([*operating, *((m.loop, m.profile) == kind for kind in kinds)])
    table = np.array(rows, np.float64)
    spread = table.std(axis=0)
    scaled: FloatArray = (table - table.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    return scaled


def refitted(fitter: ModelFitter, models: FittedModels, conclusion: Conclusion) -> FittedModels:
    """The base model, the models believed and those with the smallest errors, refitted."""
    ranked = sorted(models.with_effects.values(), key=lambda fit: fit.J)
    believed = [fit for fit in conclusion.stages if fit.effects]
    tied = [f for names, f in models.with_effects.items() if names & {*conclusion.tied}]
    chosen = {fit.names: fit for fit in (*ranked[:4], *believed, *tied)}
    base = FittedModels(fitter.given(), carried_over(fitter, models.base))
    return base.adding(carried_over(fitter, fit) for fit in chosen.values())


def carried_over(fitter: ModelFitter, model: CandidateFit) -> CandidateFit:
    """A model fitted to other records, from its values on some."""
    settled = settle(fitter, model, 4)
    return fitter.fit(model.effects, settled.fitted.values)


def settle(fitter: ModelFitter, model: CandidateFit, rounds: int = 15) -> CandidateFit:
    """A fitted model on other records, with only what belongs to each of them fitted."""
    row = fitter.predictor(model.effects).row(shared(model.values))
    return fitter.fit(model.effects, row, rounds, owners=frozenset())


def shared(values: Mapping[str, float]) -> dict[str, float]:
    """The values that do not belong to single records."""
    return {name: value for name, value in values.items() if not name.endswith("]")}


class AllRecords(NamedTuple):
    """What a search believes, fitted to all records.

    Attributes:
        fitter: The model with all records, mains interference taken out.
        models: The base model, what is believed and what comes near.
        line: The mains interference, or None.
        recorded: The base model fitted to the records with interference, where there is some.
        refitted: Whether models were fitted anew.
    """

    fitter: ModelFitter
    models: FittedModels
    line: MainsLine | None
    recorded: tuple[ModelFitter, CandidateFit] | None
    refitted: bool


def on_all_records(
    plant: DiagnosedModel,
    searched: ModelFitter,
    models: FittedModels,
    conclusion: Conclusion,
    line: MainsLine | None,
) -> AllRecords:
    """The models of a search fitted to all records.

    Mains interference is estimated again with the effects that are believed: without them their
    response may resemble a line.
    """
    all_searched = len(searched.measurements) == len(plant.measurements)
    if line is None and all_searched:
        return AllRecords(searched, models, None, None, refitted=False)
    recorded = ModelFitter(plant, plant.measurements, searched.floor)
    remaining = line
    best = conclusion.stages[-1]
    if line is not None and (best.effects or not all_searched):
        believed = carried_over(recorded, best)
        remaining = line_in_residual(recorded, believed, plant.measurements)
    if remaining is None:
        models = refitted(recorded, models, conclusion)
        return AllRecords(recorded, models, None, None, refitted=True)
    with_line = recorded, carried_over(recorded, models.base)
    if all_searched:
        return AllRecords(searched, models, line, with_line, refitted=False)
    cleaned = remaining.measurements
    fitter = ModelFitter(plant.for_records(cleaned), cleaned, searched.floor)
    models = refitted(fitter, models, conclusion)
    return AllRecords(fitter, models, remaining, with_line, refitted=True)
