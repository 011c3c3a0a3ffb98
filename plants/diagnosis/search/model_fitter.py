"""Fits of models with effects to all the records."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.models.free_parameters import Free
from plants.diagnosis.prediction.prediction import Prediction, Predictor
from plants.diagnosis.search.least_squares import WhitenedFit, fit, smoothing_steps
from plants.effects import Effect, Port, RecordScale, Role

Effects = tuple[type[Effect], ...]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class CandidateFit:
    """A model with effects, fitted to some entries."""

    effects: Effects
    fitted: WhitenedFit

    @property
    def J(self) -> float:
        """Mean square of the whitened residuals; 1 is the noise floor."""
        return self.fitted.mean_square

    @property
    def names(self) -> frozenset[str]:
        """Slugs of the effects."""
        return frozenset(e.name for e in self.effects)

    @property
    def values(self) -> dict[str, float]:
        """The values by name."""
        return self.fitted.predictor.values(self.fitted.values)

    @property
    def own_values(self) -> int:
        """Number of the effects' values that are not at a bound."""
        listed = zip(self.fitted.predictor.free, self.fitted.values.tolist(), strict=True)
        return sum(f.owner in self.names and not edges(f, value) for f, value in listed)

    def at_bound(self, effect: type[Effect]) -> bool:
        """Whether an effect's size, or the length of its wave, is at a bound of its range."""
        waves = {f"{effect.name}.{name}" for name in effect.named(Role.PERIODS)}
        listed = zip(self.fitted.predictor.free, self.fitted.values.tolist(), strict=True)
        for f, value in listed:
            at = edges(f, value)
            belongs = f.owner == effect.name and (f.neutral is not None or f.name in waves)
            if belongs and at and f.neutral not in at:
                return True
        return False


def edges(free: Free, value: float) -> list[float]:
    """The bounds that a value is at."""
    return [edge for edge in (free.low, free.high) if math.isclose(value, edge, rel_tol=1e-6)]


class ModelFitter:
    """Fits models with effects to the records.

    Attributes:
        entries: Numbers of the residual entries that count: all, or of many evenly some.
        group: Number of the block of time each entry lies in.
    """

    def __init__(
        self, model: DiagnosedModel, measurements: Sequence[MeasuredRecord], floor: NoiseFloor
    ) -> None:
        self.model, self.measurements, self.floor = model, tuple(measurements), floor
        self._predictors: dict[Effects, Predictor] = {}
        self.base = self.predictor(())
        sample = self.base.index.sample
        stride = max(1, sample.size // CONSTANTS.searched)
        self.entries: Numbers = np.flatnonzero(sample % stride == 0)
        self.group = self._blocks()

    def predictor(self, effects: Effects) -> Predictor:
        """The model with effects, compiled once whatever their order."""
        effects = self.ordered(effects)
        if effects not in self._predictors:
            self._predictors[effects] = Predictor(
                self.model, effects, self.measurements, floor=self.floor
            )
        return self._predictors[effects]

    @staticmethod
    def ordered(effects: Effects) -> Effects:
        """The effects in the order in which a structure has them."""
        return tuple(sorted(effects, key=lambda e: e.name))

    def given(self) -> CandidateFit:
        """The model as given, with only the values of single records fitted."""
        return self.fit((), self.base.start, owners=frozenset())

    def base_fit(self) -> CandidateFit:
        """The model without effects, from its own numbers and from those that fit best.

        The second starts from a fit without the prior: a number that is given far wrong then keeps
        its new value if the error is smaller there.
        """
        near = self.fit((), self.base.start, 40)
        if CONSTANTS.floor >= near.J or all(f.prior is None for f in self.base.free):
            return near
        moves = self.moves(self.base)
        begun = fit(self.base, near.fitted.values, moves, self.entries, informed=False)
        far = self.fit((), begun.values, 40)
        return min((near, far), key=lambda fit_: fit_.fitted.penalised)

    def moves(self, predictor: Predictor, owners: frozenset[str] | None = None) -> Numbers:
        """Numbers of the values of single records, and of some owners or names; None is all."""
        return np.array(
            [
                n
                for n, f in enumerate(predictor.free)
                if owners is None or {f.owner, f.name} & owners or record_of(f.owner) is not None
            ],
            dtype=np.int64,
        )

    def fit(
        self,
        effects: Effects,
        row: FloatArray,
        rounds: int = 15,
        owners: frozenset[str] | None = None,
        held: Sequence[str] = (),
    ) -> CandidateFit:
        """A model fitted from one row of values.

        Args:
            effects: The effects added.
            row: Values to begin with, shape (free,).
            rounds: Most rounds.
            owners: Whose values, or which by name, move besides those of single records.
            held: Names of values that do not move.
        """
        effects = self.ordered(effects)
        predictor = self.predictor(effects)
        moves = self.moves(predictor, owners)
        moves = np.array([n for n in moves if predictor.free[n].name not in held], np.int64)
        return CandidateFit(effects, fit(predictor, row, moves, self.entries, rounds))

    def refine(self, model: CandidateFit, rounds: int = 15) -> CandidateFit:
        """The same, fitted on with all its values."""
        moves = self.moves(model.fitted.predictor)
        if model.fitted.converged and model.fitted.moved.size == moves.size:
            return model
        return self.fit(model.effects, model.fitted.values, rounds)

    def final(self, model: CandidateFit) -> CandidateFit:
        """The same, fitted until it has converged."""
        fitted = model.fitted
        moved = fitted.moved
        done = fit(fitted.predictor, fitted.values, moved, self.entries, 60, tolerance=1e-5)
        if model.effects:
            over = smoothing_steps(done)
            begun = fitted.predictor, done.values, moved, self.entries
            done = fit(*begun, 12, tolerance=1e-4, over=over)
        return CandidateFit(model.effects, done)

    def best_starts(self, predictor: Predictor, rows: FloatArray, most: int) -> FloatArray:
        """The rows of values with the smallest residuals."""
        if len(rows) <= 1:
            return rows
        squares = _squares(predictor, rows, self.entries, np.zeros(1, np.int64))[:, 0]
        best: FloatArray = rows[squares.argsort()[:most]]
        return best

    def placed(self, effects: Effects, rows: FloatArray) -> FloatArray:
        """Rows with each record's own values moved to where the residuals are least.

        An effect that bends the cable's law shifts the angle at which the cable is taut by more
        than a fit can correct. A wave over the angle is shifted in records whose zero only the
        wave shows.
        """
        predictor = self.predictor(effects)
        kinds: dict[str, dict[int, int]] = {}
        for n, f in enumerate(predictor.free):
            record = record_of(f.owner)
            if record is not None:
                kinds.setdefault(f.name.partition("[")[0], {})[record] = n
        if any(e.named(Role.PHASE) for e in effects):
            known = {f.name.partition("[")[0] for f in self.base.free}
            waves = [f"{e.name}.{name}" for e in effects for name in e.named(Role.PERIODS)]
            periods = [n for n, f in enumerate(predictor.free) if f.name in waves]
            per_turn = rows[:, periods[-1]] if periods else np.ones(len(rows))
            length = 2.0 * math.pi / per_turn
            for places in (of for kind, of in kinds.items() if kind not in known):
                turns = np.arange(8) / 8.0 * length[:, None]
                rows = self._shifted(predictor, rows, places, turns)
        if {Port.CABLE, Port.EYELET} & {port for e in effects for port in e.ports()}:
            for places in kinds.values():
                rows = self._shifted(predictor, rows, places, None)
        return rows

    def _shifted(
        self, predictor: Predictor, rows: FloatArray, values: dict[int, int], by: FloatArray | None
    ) -> FloatArray:
        """Rows with one kind of the records' own values shifted, each by the best of some shifts.

        Args:
            predictor: The model.
            rows: Values, shape (rows, free).
            values: Numbers of the values by record.
            by: Shifts of each row, shape (rows, shifts); None is some, in noise floors.
        """
        records, places = np.array(list(values)), np.array(list(values.values()))
        entries = self.entries[np.isin(predictor.index.measurement[self.entries], records)]
        records_there, first = np.unique(predictor.index.measurement[entries], return_index=True)
        unit = np.ones(places.size)
        if by is None:
            _, slope = predictor.linearise(rows[0], places, entries)
            steepness = np.sqrt(np.einsum("ij,ij->j", slope, slope) / entries.size)
            if not steepness.all():
                return rows
            powers = np.array([0.0, *(sign * 3.0**n for n in range(6) for sign in (-1, 1))])
            by, unit = np.tile(powers, (len(rows), 1)), 1.0 / steepness
        many = by.shape[1]
        shifted = np.repeat(rows, many, axis=0)
        shifted[:, places] += by.reshape(-1, 1) * unit
        squares = _squares(predictor, shifted, entries, first)
        best = squares.reshape(len(rows), many, -1).argmin(axis=1)
        chosen = np.take_along_axis(by, best, axis=1)[:, np.searchsorted(records_there, records)]
        rows = rows.copy()
        rows[:, places] += chosen * unit
        return rows

    def _blocks(self) -> Numbers:
        index = self.base.index
        most = 24 if len(self.measurements) <= 2 else 12
        group, first = np.zeros(index.sigma.size, np.int64), 0
        for n in range(len(self.measurements)):
            of_record = np.flatnonzero(index.measurement == n)
            windows, place = np.unique(index.window[of_record], return_inverse=True)
            blocks = max(1, min(most, windows.size // 3))
            group[of_record] = first + place * blocks // max(windows.size, 1)
            first += blocks
        return group

    def free_run(self, model: CandidateFit) -> list[Prediction]:
        """Each record simulated from its start, without resets."""
        values = model.values
        running = Predictor(self.model, model.effects, self.measurements, None, self.floor)
        known = {f.name for f in running.free}
        row = running.row({name: value for name, value in values.items() if name in known})
        return running.predict(row[None, :])

    @cached_property
    def scale(self) -> RecordScale:
        """Scales that sizes of effects are judged by."""
        angle_rad, tension_N = self.floor.angle_rad, self.floor.tension_N
        if math.isnan(angle_rad):
            model = self.model.calibrated({})
            numbers = [BaseNumbers.of(model, m) for m in self.measurements]
            pulls = [math.nan if b is None else b.tension_per_angle_N_rad for b in numbers]
            angle_rad = tension_N / float(np.median(pulls))
        return self.model.sizes._replace(
            angle_noise_rad=angle_rad, tension_noise_N=tension_N / abs(self.model.reading_unit)
        )


def _squares(
    predictor: Predictor, rows: FloatArray, entries: Numbers, first: Numbers
) -> FloatArray:
    """Sums of squared residuals from each of some entries to the next, shape (rows, sums)."""
    sums = np.empty((len(rows), first.size))
    for begin in range(0, len(rows), 16):
        chunk = slice(begin, begin + 16)
        residuals = predictor.residuals(rows[chunk], entries)
        np.add.reduceat(np.square(residuals, out=residuals), first, axis=1, out=sums[chunk])
    return sums


def record_of(owner: str) -> int | None:
    """Number of the record that a free value belongs to, or None."""
    return int(owner.removeprefix("record ")) if owner.startswith("record ") else None
