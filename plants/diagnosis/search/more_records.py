"""Searches on a few of many records, and fits carried over from some records to others."""

from collections.abc import Mapping, Sequence

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.search.conclusion import Conclusion
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.search import LEADING, SearchResult

SEARCHED_samples = 60_000
"""Samples that a search takes: of 80 records of 10 000 samples, six."""
SETTLING = 4
"""Rounds in which only the values of single records move."""


def differing(measurements: Sequence[MeasuredRecord]) -> tuple[MeasuredRecord, ...]:
    """Records that differ the most in gains, profile and operating point, no more than are needed.

    Each is the one farthest from those taken before (Gonzalez 1985), the first the one that moves
    the most. All of them where there are not many samples.
    """
    if sum(m.samples for m in measurements) <= SEARCHED_samples:
        return tuple(measurements)
    at = _places(measurements)
    taken = [int(at[:, 0].argmax())]
    apart = np.full(len(at), np.inf)
    while True:
        apart = np.minimum(apart, np.linalg.norm(at - at[taken[-1]], axis=1))
        apart[taken] = -1.0
        further = int(apart.argmax())
        if sum(measurements[n].samples for n in (*taken, further)) > SEARCHED_samples:
            return tuple(measurements[n] for n in sorted(taken))
        taken.append(further)


def _places(measurements: Sequence[MeasuredRecord]) -> FloatArray:
    """Motion, operating point, gains and profile of each, in standard deviations."""
    kinds = sorted({(m.loop, m.profile) for m in measurements})
    rows = []
    for m in measurements:
        moved = next(np.asarray(m.channel(name)) for name in (*m.outputs, "current_A"))
        gains = (0.0, 0.0, 0.0, 0.0)
        if m.gains is not None:
            gains = (m.gains.P, m.gains.I, m.gains.D, m.gains.setpoint_filter_s)
        own = (float(np.nanstd(moved)), m.preload_N, m.cable_length_m or 0.0, *gains)
        rows.append([*own, *((m.loop, m.profile) == kind for kind in kinds)])
    place = np.array(rows, np.float64)
    spread = place.std(axis=0)
    found: FloatArray = (place - place.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    return found


def confirmed(fitter: ModelFitter, found: SearchResult, judged: Conclusion) -> SearchResult:
    """A search's base model, what it believes and what comes near, fitted to all records.

    Args:
        fitter: The model with all records.
        found: A search on some of them.
        judged: Its conclusion.
    """
    leading = sorted(found.fits.values(), key=lambda one: one.J)[:LEADING]
    stages = [one for one in judged.stages if one.effects]
    tied = [one for names, one in found.fits.items() if names & {*judged.tied}]
    base = carried_over(fitter, found.base)
    result = SearchResult(base, fitter.given(), {}, found.screened, found.beside)
    chosen = {one.names: one for one in (*leading, *stages, *tied)}
    result.add(carried_over(fitter, one) for one in chosen.values())
    return result


def carried_over(fitter: ModelFitter, one: CandidateFit) -> CandidateFit:
    """A model fitted to other records, from its values on some."""
    settled = settle(fitter, one, SETTLING)
    return fitter.fit(one.effects, settled.fitted.values)


def settle(fitter: ModelFitter, one: CandidateFit, rounds: int = 15) -> CandidateFit:
    """A fitted model on other records, with only what belongs to each of them fitted."""
    row = fitter.predictor(one.effects).row(shared(one.values))
    return fitter.fit(one.effects, row, rounds, owners=frozenset())


def shared(values: Mapping[str, float]) -> dict[str, float]:
    """The values that do not belong to single records."""
    return {name: value for name, value in values.items() if not name.endswith("]")}
