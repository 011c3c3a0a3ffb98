"""Which effects are worth a fit: how far each one's direction points along the residual.

An effect is switched on at a size that moves the residual by about as much as it is, for several
values of its other parameters. What that changes in the whitened residuals, less what the base
model's calibrations can undo, is its direction. The squared cosine between direction and residual
is the share of the residual that the effect would explain if it acted in proportion to its size.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.prediction.prediction import Predictor
from plants.diagnosis.search.score_context import ScoreContext
from plants.effects import Effect, Role

DECADES = np.arange(-2.5, 3.5, 0.5)
"""Sizes tried, in powers of ten of the usual one, when one that moves the residual is sought: less
than the first moves it in proportion, and is not seen better."""
MOVED = (0.5, 3.0)
"""How far the sizes chosen move the residual, in its own size: a law that is bent points another
way when it acts strongly."""
LEVELS = 14
"""Values tried of a limit, whose neutral value is its greatest and lies far away."""
GRID = 7
"""Values tried of a parameter that has no neutral value."""
FREQUENCIES = 40
"""The same of a frequency, beside those the data suggest: some 10 % apart, a resonance damped as
frames are is seen from the next one."""
ROWS = 20
"""Most combinations of such values."""
MODES = 100
"""The same where one of them is a frequency."""
WIDE = 15.0
"""How far from the usual value they reach, as a factor."""
APART = 0.3
"""Logarithm of the ratio from which on two frequencies are worth a start each."""
FURTHEST = 30.0
"""A size may be extrapolated by this factor from the one that was tried."""
STARTS = 2
"""Starts kept of an effect, the most promising first."""
ACTING = 1e-3
"""A limit acts that changes the residuals by more than this, in floors."""


@dataclass(frozen=True, slots=True, eq=False)
class ScreeningResult:
    """An effect's direction.

    Attributes:
        effect: The effect.
        predictor: The model with it.
        starts: Rows of values to begin fits with, the most promising first, shape (some, free).
        grids: Values to try of each parameter that has no neutral value and is no phase.
        screening_R2: Share of the residual that the best start's direction explains.
        changes: What the best start changes in the residuals, shape (sizes, screened).
        usual_change: Root mean square change of the residuals at the usual size of the effect, in
            floors, less what calibrations can undo.
    """

    effect: type[Effect]
    predictor: Predictor
    starts: FloatArray
    grids: Mapping[str, list[float]]
    screening_R2: float
    changes: FloatArray
    usual_change: float


def screen(
    effect: type[Effect], predictor: Predictor, seen: Sequence[ScoreContext]
) -> ScreeningResult:
    """An effect's direction along the residual.

    Args:
        effect: The last of the predictor's effects.
        predictor: The model with it.
        seen: The fit without it, then other places from which to look.
    """
    found = [_Probe(effect, predictor, one).screened() for one in seen]
    best = max(found, key=lambda one: one.screening_R2)
    starts = np.concatenate([one.starts for one in found])
    return replace(found[0], screening_R2=best.screening_R2, starts=starts)


class _Way(NamedTuple):
    """One way in which an effect was switched on."""

    share: float
    start: FloatArray
    changes: FloatArray


class _Probe:
    """One effect switched on in several ways at the values of the fit without it."""

    def __init__(self, effect: type[Effect], predictor: Predictor, seen: ScoreContext) -> None:
        place = {f.name: n for n, f in enumerate(predictor.free)}
        self.effect, self.predictor, self.seen = effect, predictor, seen
        self.declared = effect.parameters()
        self.column = {name: place[f"{effect.name}.{name}"] for name in self.declared}
        self.sizes = [name for name, p in self.declared.items() if p.neutral is not None]
        self.phases = [n for n, p in self.declared.items() if p.neutral is None and p.is_phase]
        # A wave over an angle whose zero each record has for itself, and nothing else tells.
        own = (f.name for f in predictor.free if f.owner.startswith("record "))
        self.loose = bool(effect.named(Role.PERIODS)) and any(
            name not in seen.values for name in own
        )
        self.off = predictor.row(seen.values)
        for name in self.sizes:
            self.off[self.column[name]] = self.declared[name].neutral
        self.here = seen.shown(predictor.residuals(self.off[None, :], seen.entries))[0]

    def screened(self) -> ScreeningResult:
        """The best of all the ways."""
        ways, reach = self._limits() if is_limit(self.effect) else self._amplitudes()
        ways.sort(key=lambda way: -way.share)
        most = STARTS + len(self.phases)  # a period is soon lost
        starts = np.array([way.start for way in self._apart(ways)[:most]])
        best = ways[0]
        return ScreeningResult(
            *(self.effect, self.predictor, starts, self._grids()),
            *(best.share, best.changes, reach),
        )

    def _apart(self, ways: list["_Way"]) -> list["_Way"]:
        """The ways, of those with frequencies side by side the most promising alone."""
        rates = [self.column[n] for n, p in self.declared.items() if p.unit == "Hz"]
        kept: list[_Way] = []
        for way in ways:
            near = (np.abs(np.log(way.start[rates] / k.start[rates])) for k in kept)
            if not rates or all((distance > APART).any() for distance in near):
                kept.append(way)
        return kept

    def _changes(self, rows: FloatArray) -> FloatArray:
        """What rows change in the residuals screened, shape (rows, screened)."""
        found = self.seen.shown(self.predictor.residuals(rows, self.seen.entries)) - self.here
        changes: FloatArray = np.where(np.isfinite(found), found, 0.0)
        return changes

    def _limits(self) -> tuple[list[_Way], float]:
        """Levels of a limit from where it begins to act."""
        name = self.sizes[0]
        p = self.declared[name]
        nothing = [_Way(0.0, self.off.copy(), np.zeros((1, self.here.size)))]
        levels = np.geomspace(p.low, p.high, LEVELS)
        change = self.seen.projected_products(self._changes(self._rows(name, levels))).rms
        acting = np.flatnonzero(change > ACTING)
        if not acting.size:
            return nothing, 0.0
        top = min(int(acting[-1]) + 1, LEVELS - 1)
        # From where it does not act to where it changes as much as there is to explain.
        enough = acting[change[acting] > max(1.0, 2.0 * self.seen.size)]
        bottom = int(enough[-1]) if enough.size else int(acting[0])
        rows = self._rows(name, np.geomspace(levels[bottom], levels[top], LEVELS))
        changes = self._changes(rows)
        products = self.seen.projected_products(changes)
        ways = []
        for n in np.flatnonzero(products.rms > ACTING).tolist():
            share, weights = products.of(slice(n, n + 1)).explained(only_up=True)
            # It does not act in proportion: what has to be stretched far is no direction.
            fits = math.exp(-0.1 * math.log(max(float(weights[0]), 1e-9)) ** 2)
            ways.append(_Way(share * fits, rows[n], changes[n : n + 1]))
        return ways or nothing, float(change.max())

    def _amplitudes(self) -> tuple[list[_Way], float]:
        """Sizes that act in proportion, for several values of the other parameters."""
        sizes, reach = self._sizes()
        combinations = [(tried, shape) for tried in sizes for shape in self._shapes()]
        rows = [
            self._at(shape, name, tried[name], phase)
            for tried, shape in combinations
            for name in self.sizes
            for phase in self._turns()
        ]
        changes = self._changes(np.array(rows))
        each = len(rows) // len(combinations)
        blocks = [slice(n, n + each) for n in range(0, len(rows), each)]
        if self.loose:
            found = [self._turned(changes[block]) for block in blocks]
        else:
            all_ = self.seen.projected_products(changes)
            found = [
                all_.of(block).explained(only_up=self._only_up(tried))
                for block, (tried, _) in zip(blocks, combinations, strict=True)
            ]
        ways = [
            _Way(share, self._start(shape, tried, weights), changes[block])
            for (tried, shape), block, (share, weights) in zip(
                combinations, blocks, found, strict=True
            )
        ]
        return ways, reach

    def _turned(self, changes: FloatArray) -> tuple[float, FloatArray]:
        """Share of the residual that a wave explains whose phase each record has for itself.

        Args:
            changes: What its sine and its cosine change, shape (2, screened).

        Returns:
            The share, and the weights of both for the amplitude that the records have in common.
        """
        record = self.predictor.index.measurement[self.seen.entries]
        records = np.unique(record)
        apart = changes[:, None, :] * (record == records[:, None])
        products = self.seen.projected_products(apart.reshape(-1, record.size))
        share, weights = products.explained(only_up=False)
        size2 = np.sum(weights.reshape(2, -1) ** 2, axis=0)
        # As much as a record shows of it.
        shown = np.sum(products.rms.reshape(2, -1) ** 2, axis=0)
        amplitude = math.sqrt(float(size2 @ shown) / max(float(shown.sum()), 1e-300))
        return share, np.array([amplitude, 0.0])

    def _sizes(self) -> tuple[list[dict[str, float]], float]:
        """Sizes that move the residual by about what it is, and more; how far the usual does."""
        usual = self.predictor.start
        values, places = {}, []
        rows: list[FloatArray] = []
        for name in self.sizes:
            p = self.declared[name]
            assert p.neutral is not None  # noqa: S101  a size is what has a neutral value
            step = float(usual[self.column[name]]) - p.neutral or 1e-2 * (p.high - p.low)
            values[name] = np.clip(p.neutral + step * 10.0**DECADES, p.low, p.high)
            # Beyond the bounds all are one.
            different, place = np.unique(values[name], return_inverse=True)
            places.append(sum(len(r) for r in rows) + place)
            rows.append(self._rows(name, different))
        change = self.seen.projected_products(self._changes(np.concatenate(rows))).rms[
            np.array(places)
        ]
        reach = float(change[:, DECADES == 0.0].max())
        sizes: list[dict[str, float]] = []
        for share in MOVED:
            wanted = max(0.3, share * self.seen.size)
            nearest = np.abs(np.log((change + 1e-12) / wanted)).argmin(axis=1)
            tried = {n: float(values[n][k]) for n, k in zip(self.sizes, nearest, strict=True)}
            if tried not in sizes:
                sizes.append(tried)
        return sizes, reach

    def _only_up(self, tried: Mapping[str, float]) -> bool:
        """Whether a size may only grow from its neutral value."""
        if self.phases:
            return False
        return all(
            self.declared[n].neutral in (self.declared[n].low, self.declared[n].high)
            for n in tried
        )

    def _turns(self) -> tuple[float, ...]:
        """Phases that span all phases."""
        return (0.0, 0.5 * math.pi) if self.phases else (0.0,)

    def _rows(self, name: str, values: FloatArray) -> FloatArray:
        rows = np.tile(self.off, (len(values), 1))
        rows[:, self.column[name]] = values
        return rows

    def _at(self, shape: Mapping[str, float], name: str, size: float, phase: float) -> FloatArray:
        row = self.off.copy()
        for other, value in shape.items():
            row[self.column[other]] = value
        for other in self.phases:
            row[self.column[other]] = phase
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
            p = self.declared[name]
            assert p.neutral is not None  # noqa: S101  a size is what has a neutral value
            reached = float(np.clip(weight, -FURTHEST, FURTHEST)) * (tried[name] - p.neutral)
            row[self.column[name]] = min(max(p.neutral + reached, p.low), p.high)
        return row

    def _grids(self) -> dict[str, list[float]]:
        """Values to try of the parameters that have no neutral value."""
        shapes = (n for n, p in self.declared.items() if p.neutral is None)
        return {name: self._grid(name) for name in shapes if name not in self.phases}

    def _shapes(self) -> list[dict[str, float]]:
        """Combinations of them."""
        grids = self._grids()
        most = MODES if any(self.declared[name].unit == "Hz" for name in grids) else ROWS
        while math.prod(map(len, grids.values())) > most:
            shorter = [name for name in grids if len(grids[name]) > 2]
            cut = min(shorter, key=lambda name: len(grids[name]))
            grids[cut] = grids[cut][1::2]
        return [
            dict(zip(grids, values, strict=True)) for values in itertools.product(*grids.values())
        ]

    def _grid(self, name: str) -> list[float]:
        """Values of one parameter that has no neutral value."""
        p = self.declared[name]
        suggested = [
            v for v in self.seen.suggest(f"{self.effect.name}.{name}") if p.low <= v <= p.high
        ]
        usual = float(self.predictor.start[self.column[name]])
        if p.unit == "Hz":
            low, high = max(p.low, self.seen.lowest_Hz), min(p.high, self.seen.highest_Hz)
            return [*suggested, *np.geomspace(low, max(high, low), FREQUENCIES).tolist()]
        if suggested:
            return suggested
        if p.low > 0.0 and usual > 0.0:
            low, high = max(p.low, usual / WIDE), min(p.high, usual * WIDE)
            return [float(v) for v in np.geomspace(low, high, GRID)]
        return [float(v) for v in np.linspace(p.low, p.high, GRID)]


def is_limit(effect: type[Effect]) -> bool:
    """Whether an effect's size is one that acts when it is small: a limit, neutral far up."""
    return bool(effect.named(Role.LIMIT))
