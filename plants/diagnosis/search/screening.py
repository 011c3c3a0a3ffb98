"""Which effects are worth a fit: how far each one's sensitivity direction explains the residual.

An effect is switched on at a size that moves the residual by about as much as it is, for several
values of its other parameters. What that changes in the whitened residuals, less what the base
parameters can undo, is its direction. The squared cosine between direction and residual is the
share of the residual that the effect would explain if it acted in proportion to its size.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.prediction.prediction import Predictor
from plants.diagnosis.search.score_context import ScoreContext
from plants.effects import Effect, RecordScale, Role


@dataclass(frozen=True, slots=True, eq=False)
class ScreeningResult:
    """Screening of an effect.

    Attributes:
        starts: Rows of values to begin fits with, the most promising first, shape (some, free).
        screening_R2: Share of the residual that the best start's direction explains.
        usual_change: Root mean square change of the residuals at the usual size of the effect,
            less what base parameters can undo, in times the noise floor.
    """

    effect: type[Effect]
    predictor: Predictor
    starts: FloatArray
    grids: Mapping[str, list[float]]
    screening_R2: float
    usual_change: float


class Screening(NamedTuple):
    """Screening of all effects from one model.

    Attributes:
        declared: Of each declared effect, by slug.
        nameless: Of each law without a name, by slug.
    """

    declared: Mapping[str, ScreeningResult]
    nameless: Mapping[str, ScreeningResult]


class _Direction(NamedTuple):
    """How an effect of some values changes the residual.

    Attributes:
        share: Share of the residual that the change explains when scaled.
        start: Values to begin a fit with, shape (free,).
    """

    share: float
    start: FloatArray


class Directions:
    """What one effect, the last of a predictor's, changes at the fit without it."""

    def __init__(self, effect: type[Effect], predictor: Predictor, context: ScoreContext) -> None:
        place = {f.name: n for n, f in enumerate(predictor.free)}
        self.effect, self.predictor, self.context = effect, predictor, context
        self.declared = effect.parameters()
        self.column = {name: place[f"{effect.name}.{name}"] for name in self.declared}
        self.free = {name: predictor.free[n] for name, n in self.column.items()}
        self.sizes = effect.named(Role.SIZE, Role.LIMIT)
        self.phases = effect.named(Role.PHASE)
        sizes = [self.free[name] for name in self.sizes]
        # Sizes may only grow from their neutral values.
        self.only_up = not self.phases and all(f.neutral in (f.low, f.high) for f in sizes)
        values = context.model.values
        # A wave over an angle whose zero each record has for itself, and nothing else tells.
        of_records = (f.name for f in predictor.free if f.owner.startswith("record "))
        self.has_free_phase = bool(self.phases) and any(n not in values for n in of_records)
        self.without_effect = predictor.row(values)
        for name in self.sizes:
            self.without_effect[self.column[name]] = self.free[name].neutral
        self.residuals_without = predictor.residuals(
            self.without_effect[None, :], context.entries
        )[0]

    def screened(self) -> ScreeningResult:
        """The screening: the best of all directions."""
        limited = bool(self.effect.named(Role.LIMIT))
        directions, usual_change = self._limits() if limited else self._amplitudes()
        directions.sort(key=lambda direction: -direction.share)
        most = CONSTANTS.starts + len(self.phases)  # a period has many local minima
        starts = np.array([direction.start for direction in self._apart(directions)[:most]])
        grids = self._grids()
        return ScreeningResult(
            self.effect, self.predictor, starts, grids, directions[0].share, usual_change
        )

    def _apart(self, directions: list[_Direction]) -> list[_Direction]:
        """The directions; of those with nearly the same frequencies the most promising alone."""
        rates = [self.column[n] for n in self.effect.named(Role.FREQUENCY)]
        kept: list[_Direction] = []
        for direction in directions:
            near = (np.abs(np.log(direction.start[rates] / k.start[rates])) for k in kept)
            if not rates or all((distance > CONSTANTS.apart).any() for distance in near):
                kept.append(direction)
        return kept

    def _changes(self, rows: FloatArray) -> FloatArray:
        """Changes of the residuals screened by rows of values, shape (rows, screened)."""
        residuals = self.predictor.residuals(rows, self.context.entries) - self.residuals_without
        changes: FloatArray = np.where(np.isfinite(residuals), residuals, 0.0)
        return changes

    def _limits(self) -> tuple[list[_Direction], float]:
        """Levels of a limit from where it begins to act."""
        name = self.sizes[0]
        f = self.free[name]
        levels = np.geomspace(f.low, f.high, 2 * CONSTANTS.shapes)
        change = self.context.products(self._changes(self._rows(name, levels))).rms
        # In noise floors; less is rounding.
        acting = np.flatnonzero(change > CONSTANTS.numerics)
        if not acting.size:
            return [_Direction(0.0, self.without_effect.copy())], 0.0
        top = min(int(acting[-1]) + 1, levels.size - 1)
        # From where it does not act to where it changes as much as the residual is.
        enough = acting[change[acting] > max(1.0, 2.0 * self.context.size)]
        bottom = int(enough[-1]) if enough.size else int(acting[0])
        rows = self._rows(name, np.geomspace(levels[bottom], levels[top], levels.size))
        products = self.context.products(self._changes(rows))
        directions = []
        for n in np.flatnonzero(products.rms > CONSTANTS.numerics).tolist():
            share, weights = products.of(slice(n, n + 1)).explained(only_up=True)
            # A limit does not act in proportion to its level: a weight far from 1 is discounted.
            away = math.log(max(float(weights[0]), 1e-9))
            fits = math.exp(-CONSTANTS.disproportion * away**2)
            directions.append(_Direction(share * fits, rows[n]))
        return directions or [_Direction(0.0, self.without_effect.copy())], float(change.max())

    def _amplitudes(self) -> tuple[list[_Direction], float]:
        """Sizes that act in proportion, for several values of the shapes."""
        sizes, usual_change = self._sizes()
        turns = (0.0, 0.5 * math.pi) if self.phases else (0.0,)
        combinations = list(itertools.product(sizes, self._shapes()))
        rows = [
            self._at(shape, name, tried[name], phase)
            for tried, shape in combinations
            for name in self.sizes
            for phase in turns
        ]
        changes = self._changes(np.array(rows))
        each = len(rows) // len(combinations)
        products = None if self.has_free_phase else self.context.products(changes)
        directions = []
        for n, (tried, shape) in enumerate(combinations):
            block = slice(n * each, (n + 1) * each)
            if products is None:
                share, weights = self._turned(changes[block])
            else:
                share, weights = products.of(block).explained(only_up=self.only_up)
            directions.append(_Direction(share, self._start(shape, tried, weights)))
        return directions, usual_change

    def _turned(self, changes: FloatArray) -> tuple[float, FloatArray]:
        """Share of the residual that a wave explains whose phase each record has for itself.

        Args:
            changes: What its sine and its cosine change, shape (2, screened).

        Returns:
            The share, and the weights of both for the amplitude that the records have in common.
        """
        record = self.predictor.index.measurement[self.context.entries]
        apart = changes[:, None, :] * (record == np.unique(record)[:, None])
        products = self.context.products(apart.reshape(-1, record.size))
        share, weights = products.explained(only_up=False)
        size2 = np.sum(weights.reshape(2, -1) ** 2, axis=0)
        # As much as a record shows of it.
        shown = np.sum(products.rms.reshape(2, -1) ** 2, axis=0)
        amplitude = math.sqrt(float(size2 @ shown) / max(float(shown.sum()), 1e-300))
        return share, np.array([amplitude, 0.0])

    def _sizes(self) -> tuple[list[dict[str, float]], float]:
        """Sizes that change the residual by its rms and more; the change at the usual size."""
        decades = np.arange(-CONSTANTS.decades, CONSTANTS.decades + 1.0)
        values = {name: self._scaled(name, decades) for name in self.sizes}
        rows = np.concatenate([self._rows(name, tried) for name, tried in values.items()])
        moved = self.context.products(self._changes(rows)).rms.reshape(-1, decades.size)
        # At still greater sizes friction holds the drum, and the change is smaller.
        rising = [np.log(np.maximum.accumulate(m[: m.argmax() + 1]) + 1e-12) for m in moved]
        # The direction of a nonlinear law depends on its size.
        levels = (0.5,) if self.effect.named(Role.FREQUENCY) else (0.5, CONSTANTS.larger)
        sizes: list[dict[str, float]] = []
        for share in levels:
            wanted = math.log(max(CONSTANTS.shown, share * self.context.size))
            powers = [np.interp(wanted, change, decades[: change.size]) for change in rising]
            tried = {
                name: float(self._scaled(name, power))
                for name, power in zip(self.sizes, powers, strict=True)
            }
            if tried not in sizes:
                sizes.append(tried)
        return sizes, float(moved[:, decades == 0.0].max())

    def _scaled(self, name: str, power: FloatArray) -> FloatArray:
        """Values of a size at powers of ten of the usual one, within its bounds."""
        f, neutral = self.free[name], self.without_effect[self.column[name]]
        step = f.start - neutral or 1e-2 * (f.high - f.low)
        values: FloatArray = np.clip(neutral + step * 10.0**power, f.low, f.high)
        return values

    def _rows(self, name: str, values: FloatArray) -> FloatArray:
        rows = np.tile(self.without_effect, (len(values), 1))
        rows[:, self.column[name]] = values
        return rows

    def _at(self, shape: Mapping[str, float], name: str, size: float, phase: float) -> FloatArray:
        row = self.without_effect.copy()
        for shape_name, value in shape.items():
            row[self.column[shape_name]] = value
        row[[self.column[shape_name] for shape_name in self.phases]] = phase
        row[self.column[name]] = size
        return row

    def _start(
        self, shape: Mapping[str, float], tried: Mapping[str, float], weights: FloatArray
    ) -> FloatArray:
        """Values to begin a fit with: the sizes that explain the most."""
        row = self._at(shape, self.sizes[0], tried[self.sizes[0]], 0.0)
        if self.phases:
            sine, cosine = weights[:2]
            row[self.column[self.phases[0]]] = math.atan2(cosine, sine)
            weights = np.array([math.hypot(sine, cosine)])
        for name, weight in zip(self.sizes, weights.tolist(), strict=True):
            f, neutral = self.free[name], self.without_effect[self.column[name]]
            times = min(max(weight, -CONSTANTS.scaled_most), CONSTANTS.scaled_most)
            size = times * (tried[name] - neutral)
            row[self.column[name]] = min(max(neutral + size, f.low), f.high)
        return row

    def _shapes(self) -> list[dict[str, float]]:
        grids = self._grids()
        most = CONSTANTS.combinations * (2 if self.effect.named(Role.FREQUENCY) else 1)
        while math.prod(map(len, grids.values())) > most:
            shorter = [name for name in grids if len(grids[name]) > 2]
            cut = min(shorter, key=lambda name: len(grids[name]))
            grids[cut] = grids[cut][1::2]
        return [
            dict(zip(grids, values, strict=True)) for values in itertools.product(*grids.values())
        ]

    def _grids(self) -> dict[str, list[float]]:
        shapes = self.effect.named(Role.SHAPE, Role.FREQUENCY, Role.PERIODS)
        return {name: self._grid(name) for name in shapes}

    def _grid(self, name: str) -> list[float]:
        p, f = self.declared[name], self.free[name]
        suggested = list(self.effect.guesses(name, self.context.records))
        usual, most = f.start, CONSTANTS.shapes
        if p.role is Role.FREQUENCY:
            low, high = max(f.low, self.context.lowest_Hz), min(f.high, self.context.highest_Hz)
            tried = np.geomspace(low, max(high, low), CONSTANTS.frequencies)
            return [*suggested, *tried.tolist()]
        if suggested:
            return suggested
        shown = shown_range(p.unit, self.context.records)
        if shown is not None:
            low, high = (min(max(edge, f.low), f.high) for edge in shown)
            spans = math.ceil(math.log(max(high / low, 1.0)) / math.log(CONSTANTS.spaced))
            return [*np.geomspace(low, high, min(1 + spans, 2 * most - 1))]
        if f.low > 0.0 and usual > 0.0:
            off = CONSTANTS.usual_off
            return [*np.geomspace(max(f.low, usual / off), min(f.high, usual * off), most)]
        return [*np.linspace(f.low, f.high, most)]


def shown_range(unit: str, records: RecordScale) -> tuple[float, float] | None:
    """Range of a speed or a travel within which records show a law's shape; None for others.

    A law that bends below what the encoder resolves, or above what is size, is not told from
    one that does not bend at all.
    """
    if unit == "rad":
        low, high = records.angle_noise_rad, records.angle_rms_rad
    elif unit == "rad/s":
        low, high = records.velocity_min_rad_s, records.velocity_max_rad_s
    else:
        return None
    return (low, high) if 0.0 < low < high < math.inf else None
