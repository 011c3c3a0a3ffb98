"""Errors of a model on data that it was not fitted to: refitted with each third left out."""

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.result import DataSegment
from plants.diagnosis.search.fit import fit
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, Numbers

THIRDS = 3
REFITTED = 4
"""Rounds of a refit from the optimum."""


def held_out(fitter: ModelFitter, one: CandidateFit) -> FloatArray:
    """Whitened residuals, (entries,), each predicted by a fit to the other two thirds.

    Values of single records, as their encoder's zero, stay as all of the record gives them: they
    belong to no law, and a part of a record may not determine them.
    """
    predictor, entries = one.fitted.predictor, fitter.entries
    shared = np.setdiff1d(one.fitted.moved, fitter.moves(predictor, frozenset()))
    part = thirds(fitter)[entries]
    residuals = np.zeros(entries.size)
    for n in range(THIRDS):
        left, rest = part == n, part != n
        if not left.any() or not rest.any():
            left = rest = np.ones(entries.size, np.bool_)
        values = fit(predictor, one.fitted.values, shared, entries[rest], REFITTED).values
        residuals[left] = predictor.residuals(values[None, :], entries[left])[0]
    return residuals


def thirds(fitter: ModelFitter) -> Numbers:
    """Number of the third that each entry belongs to.

    Each record is cut in three stretches of time, dealt out in turn: so every third has a part of
    every excitation, however the data are cut into files.
    """
    index = fitter.base.index
    part = np.zeros(index.measurement.size, np.int64)
    for n in range(len(fitter.measurements)):
        mine = np.flatnonzero(index.measurement == n)
        windows, place = np.unique(index.window[mine], return_inverse=True)
        part[mine] = (n + place * THIRDS // max(windows.size, 1)) % THIRDS
    return part


def segments(fitter: ModelFitter) -> tuple[DataSegment, ...]:
    """Stretches of each record, each of which is predicted by a fit to the others."""
    index, part = fitter.base.index, thirds(fitter)
    found = []
    for n, m in enumerate(fitter.measurements):
        for third in range(THIRDS):
            times = index.time_s[(index.measurement == n) & (part == third)]
            if times.size:
                ends = float(times.min()), float(times.max())
                found.append(DataSegment(m.name, *ends, "report", third))
    return tuple(sorted(found, key=lambda s: (s.record, s.start_s)))
