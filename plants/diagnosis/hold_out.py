"""Errors of fitted models on records that had no part in the fits."""

from collections.abc import Sequence

import numpy as np

from plants.diagnosis.data.measured_record import OUTPUTS, MeasuredRecord
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.result import HoldOut, ModelErrors
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.more_records import settle
from plants.diagnosis.search.validation import floor_of


def hold_out(model: DiagnosedModel, base: CandidateFit, last: CandidateFit) -> HoldOut:
    """Errors of the model as given, of the refitted base model and of the one with effects.

    Only values that belong to single records, such as an encoder's zero, are fitted.

    Args:
        model: The model as given, for the records that were held out.
        base: The fitted base model.
        last: The fitted model with effects.
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
    """Error of the main channel where nothing is put right on the way, rms."""
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
