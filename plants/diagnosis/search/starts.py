"""Starts of fits with one more effect, and the choice of the best.

Starts lie on a grid of shapes, with the base parameters of the model as given and with those of
the current fit, which may compensate for the missing effect. Successive halving keeps the better
half of the starts in each round (Jamieson & Talwalkar 2016). Shapes are held at first: if all
values move at once, a fit often ends in a local minimum.
"""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.screening import ScreeningResult
from plants.effects import Effect, Role

SHAPES = (Role.SHAPE, Role.FREQUENCY, Role.PERIODS)


def fit_added(
    fitter: ModelFitter,
    current: CandidateFit,
    screened: ScreeningResult,
    simpler: CandidateFit | None = None,
    least: float = math.inf,
) -> CandidateFit:
    """The current model with one more effect, not yet fitted to the end.

    Args:
        simpler: The model with a simpler law that has a part of the effect, if there is one.
        least: J of the best other model: a fit that stays far above it is ended.
    """
    effects = fitter.ordered((*current.effects, screened.effect))
    predictor = fitter.predictor(effects)
    # A start with a small residual may end in a poor minimum: each origin keeps its own starts.
    pools = [[predictor.row(v) for v in _suggested(current, screened)]]
    if simpler is not None:
        for rests in (False, True) if screened.effect.named(Role.SIZE)[1:] else (False,):
            beside = _beside(fitter, screened, simpler, current, rests=rests)
            pools.append([predictor.row(v) for v in beside])
    shapes = [f"{screened.effect.name}.{n}" for n in screened.effect.named(*SHAPES)]
    sizes = screened.effect.named(Role.SIZE)
    most = max(1, (2, 4, 8)[min(len(shapes), 2)] // min(len(pools), 2))
    starts = []
    for pool in pools:
        rows = fitter.best_starts(predictor, np.array(pool), 2 * most)
        starts.append(fitter.best_starts(predictor, fitter.placed(effects, rows), most))
    rows = np.concatenate(starts)
    found = halved(fitter, effects, rows, shapes, least)
    if screened.effect.smooth or not shapes:
        return found
    usual = {f"{screened.effect.name}.{n}": getattr(screened.effect(), n) for n in sizes}
    for spread in CONSTANTS.finer:
        rows = _about(found, shapes, usual, spread)
        near = fitter.best_starts(predictor, rows, 2 * most)
        found = min(found, halved(fitter, effects, near, shapes, least), key=lambda fit: fit.J)
    return found


def _about(
    found: CandidateFit, shapes: Sequence[str], usual: Mapping[str, float], spread: float
) -> FloatArray:
    """Rows about a fit: shapes up to a share of them or their range away, sizes as usual."""
    rows, free = [], found.fitted.predictor.free
    places = [n for n, one in enumerate(free) if one.name in shapes]
    steps = np.linspace(-spread, spread, CONSTANTS.near).tolist()
    for by in itertools.product(steps, repeat=len(places)):
        row = found.fitted.values.copy()
        for n, one in enumerate(free):
            row[n] = usual.get(one.name, row[n])
        for n, step in zip(places, by, strict=True):
            one = free[n]
            grown = one.scale == "log"
            moved = row[n] * math.exp(step) if grown else row[n] + step * (one.high - one.low)
            row[n] = min(max(moved, one.low), one.high)
        rows.append(row)
    return np.array(rows)


def halved(
    fitter: ModelFitter,
    effects: tuple[type[Effect], ...],
    rows: FloatArray,
    shapes: Sequence[str],
    least: float,
) -> CandidateFit:
    """The best of several starts by successive halving."""
    # Rounds with shapes held, and the number of starts kept after them.
    for rounds, most in ((2, 4), (3, 2), (2, 1)):
        if len(rows) > most:
            fits = [fitter.fit(effects, row, rounds, held=shapes) for row in rows]
            fits.sort(key=lambda f: f.J)
            if CONSTANTS.behind * max(least, 1.0) < fits[0].J:
                return fits[0]
            rows = np.array([f.fitted.values for f in fits[:most]])
    return fitter.fit(effects, rows[0], 3)


def _suggested(current: CandidateFit, screened: ScreeningResult) -> list[dict[str, float]]:
    suggestions = []
    for row in screened.starts:
        values = screened.predictor.values(row)
        if current.effects:  # its screening was at the base model
            prefix = f"{screened.effect.name}."
            values = current.values | {n: v for n, v in values.items() if n.startswith(prefix)}
        suggestions.append(values)
    return suggestions


def _beside(
    fitter: ModelFitter,
    screened: ScreeningResult,
    simpler: CandidateFit,
    current: CandidateFit,
    *,
    rests: bool,
) -> list[dict[str, float]]:
    """Values near a simpler law's fit: over the grid of shapes, its size split in several ways.

    Each from the calibrations of that fit, and from those of the model as given.

    Args:
        simpler: The model with the simpler law.
        current: The model without either.
        rests: Whether the effect adds to the simpler law at rest, rather than takes of its size.
    """
    effect, name = screened.effect, screened.effect.name
    inherited, source = effect.inherits, getattr(effect.extends, "name", "")
    inherited_values = {
        f"{name}.{to}": simpler.values[f"{source}.{of}"] for to, of in inherited.items()
    }
    for to in inherited:
        # Friction that builds up over less than shows is a step, along which no fit gets on.
        at = f"{name}.{to}"
        if rests and effect.parameters()[to].unit == "rad" and fitter.floor.angle_rad > 0.0:
            inherited_values[at] = max(inherited_values[at], fitter.floor.angle_rad)
    sizes = [n for n in effect.named(Role.SIZE, Role.LIMIT) if n not in inherited]
    grids = {n: v for n, v in screened.grids.items() if n not in inherited}
    main = next((to for to in inherited if to in effect.named(Role.SIZE, Role.LIMIT)), None)
    origins: list[Mapping[str, float]] = [simpler.values]
    if not current.effects:
        begun = fitter.base
        records = {f.name for f in begun.free if f.owner.startswith("record ")}
        start = begun.values(begun.start)
        kept = {n: v for n, v in simpler.values.items() if n in records or n not in start}
        origins.append(start | kept)
    suggestions = []
    for origin in origins:
        for values in itertools.product(*grids.values()):
            shape = {f"{name}.{n}": v for n, v in zip(grids, values, strict=True)}
            if main is None:
                usual = {f"{name}.{n}": float(getattr(effect(), n)) for n in sizes}
                suggestions.append({**origin, **inherited_values, **shape, **usual})
                continue
            whole = inherited_values[f"{name}.{main}"]
            for share in (0.25, 0.5) if sizes else (0.0,):
                split = {f"{name}.{n}": share * whole for n in sizes}
                # What is there at rest alone is beside what the simpler law found in motion.
                remaining = whole if rests or not sizes else whole * (1.0 - share)
                sized = {f"{name}.{main}": remaining} | split
                suggestions.append({**origin, **inherited_values, **shape, **sized})
    return suggestions
