"""Errors of models on data that they were not fitted to.

Thirds are left out in turn of the records that are fitted, and whole records held out of all fits.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import OUTPUTS, MeasuredRecord
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.prediction.prediction import CHANNELS
from plants.diagnosis.result import HoldOut, ModelErrors, SearchStep
from plants.diagnosis.search.least_squares import fit
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, Numbers
from plants.diagnosis.search.more_records import settle


class ModelStage(NamedTuple):
    """A model on the way to the one that is believed.

    Attributes:
        step: What it added, and its prediction error on data left out.
    """

    fitter: ModelFitter
    fit: CandidateFit
    step: SearchStep


def stage(fitter: ModelFitter, model: CandidateFit, added: str | None) -> ModelStage:
    """A model with its error on data left out; `added` is the effect that the one before lacks."""
    ratio = float(np.sqrt(np.mean(held_out(fitter, model) ** 2)))
    floor = floor_of(fitter)
    return ModelStage(fitter, model, SearchStep(added, ratio * floor, floor, ratio))


def floor_of(fitter: ModelFitter) -> float:
    """The noise floor of the main channels, rms."""
    index = fitter.base.index
    main = [CHANNELS.index(n) for n in OUTPUTS if n.endswith(f"_{fitter.model.output}")]
    sigma = index.sigma[np.isin(index.channel, main)]
    return float(np.sqrt(np.mean(sigma**2))) if sigma.size else float("nan")


def held_out(fitter: ModelFitter, model: CandidateFit) -> FloatArray:
    """Whitened residuals, (entries,), each predicted by a fit to the other two thirds.

    Values of single records, as their encoder's zero, stay as all of the record gives them: they
    belong to no law, and a part of a record may not determine them.
    """
    predictor, entries = model.fitted.predictor, fitter.entries
    shared = np.setdiff1d(model.fitted.moved, fitter.moves(predictor, frozenset()))
    third = thirds(fitter)[entries]
    residuals = np.zeros(entries.size)
    for n in range(3):
        left_out, others = third == n, third != n
        if not left_out.any() or not others.any():
            left_out = others = np.ones(entries.size, np.bool_)
        values = fit(predictor, model.fitted.values, shared, entries[others], 4).values
        residuals[left_out] = predictor.residuals(values[None, :], entries[left_out])[0]
    return residuals


def thirds(fitter: ModelFitter) -> Numbers:
    """Number of the third that each entry belongs to.

    Each record is cut in three stretches of time, dealt out in turn: so every third has a part of
    every excitation, however the data are cut into files.
    """
    index = fitter.base.index
    third = np.zeros(index.measurement.size, np.int64)
    for n in range(len(fitter.measurements)):
        of_record = np.flatnonzero(index.measurement == n)
        windows, place = np.unique(index.window[of_record], return_inverse=True)
        third[of_record] = (n + place * 3 // max(windows.size, 1)) % 3
    return third


def hold_out(model: DiagnosedModel, base: CandidateFit, last: CandidateFit) -> HoldOut:
    """Errors of the model as given, of the refitted base model and of the one with effects.

    Only values that belong to single records, such as an encoder's zero, are fitted.
    """
    measurements = model.measurements
    fitter = ModelFitter(model, measurements, noise_floor(measurements))
    before = held_errors(fitter, fitter.given())
    fits = [settle(fitter, fit) for fit in (base, last)]
    return HoldOut(
        tuple(m.name for m in measurements),
        floor_of(fitter),
        before,
        *(held_errors(fitter, fit) for fit in fits),
    )


def held_errors(fitter: ModelFitter, model: CandidateFit) -> ModelErrors:
    """Errors of a model on the records that it is compared with."""
    ratio = float(np.sqrt(model.J))
    return ModelErrors(ratio * floor_of(fitter), ratio, free_run_rms(fitter, model))


def free_run_rms(fitter: ModelFitter, model: CandidateFit) -> float:
    """Error of the main channel in free run, rms."""
    name = main_channel(fitter.measurements, fitter.model.output)
    errors = []
    for m, run in zip(fitter.measurements, fitter.free_run(model), strict=True):
        measured, predicted = m.channel(name), getattr(run, name)
        if measured is not None and predicted is not None:
            errors.append(predicted[0] - measured)
    return float(np.sqrt(np.nanmean(np.concatenate(errors) ** 2))) if errors else float("nan")


def moved_rms(fitter: ModelFitter) -> float:
    """Motion of the main channel about its mean in each record, rms."""
    name = main_channel(fitter.measurements, fitter.model.output)
    columns = (m.channel(name) for m in fitter.measurements)
    moved = [column - column.mean() for column in columns if column is not None]
    return float(np.sqrt(np.mean(np.concatenate(moved) ** 2)))


def main_channel(measurements: Sequence[MeasuredRecord], unit: str) -> str:
    """The channel whose error is reported, by the unit of prediction errors."""
    channels = {name for m in measurements for name in m.outputs}
    return next(n for n in OUTPUTS if n in channels and n.endswith(f"_{unit}"))
