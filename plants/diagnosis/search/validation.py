"""Errors of a model on data that it was not fitted to: refitted with each third left out."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import OUTPUTS
from plants.diagnosis.prediction.prediction import CHANNELS
from plants.diagnosis.result import DataSegment, SearchStep
from plants.diagnosis.search.least_squares import fit
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, Numbers

THIRDS = 3
REFITTED = 4
"""Rounds of a refit from the optimum."""


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
    for n in range(THIRDS):
        left_out, others = third == n, third != n
        if not left_out.any() or not others.any():
            left_out = others = np.ones(entries.size, np.bool_)
        values = fit(predictor, model.fitted.values, shared, entries[others], REFITTED).values
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
        third[of_record] = (n + place * THIRDS // max(windows.size, 1)) % THIRDS
    return third


def segments(fitter: ModelFitter) -> tuple[DataSegment, ...]:
    """Stretches of each record, each of which is predicted by a fit to the others."""
    index, third_of = fitter.base.index, thirds(fitter)
    stretches = []
    for n, m in enumerate(fitter.measurements):
        for third in range(THIRDS):
            times = index.time_s[(index.measurement == n) & (third_of == third)]
            if times.size:
                ends = float(times.min()), float(times.max())
                stretches.append(DataSegment(m.name, *ends, "report", third))
    return tuple(sorted(stretches, key=lambda s: (s.record, s.start_s)))
