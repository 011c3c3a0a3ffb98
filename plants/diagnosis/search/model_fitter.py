"""Fits of models with effects to the records, and how they do on data that was not fitted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.prediction.prediction import Prediction, Predictor
from plants.diagnosis.search.cable_block import Blocks, CableBlock, pull_N_rad
from plants.diagnosis.search.data_splits import FIT, RANK, REPORT, DataSplit, split_data
from plants.diagnosis.search.fit import WhitenedFit, fit, settled, switched_on
from plants.effects import Effect, Port, RecordScale, Role

SHIFTS = np.array([0.0, *(sign * 3.0**n for n in range(6) for sign in (-1, 1))])
"""Shifts of a record's own value, in floors of change, among which the best is begun with."""
TURNS = np.arange(8) / 8.0
"""Shares of a period by which a record's wave is turned, among which the best is begun with."""
PLACINGS = 6
"""Most times that a held-out record's own values are shifted, each time from where the last ended:
no fit has led near to them, and where they begin a bent law may be many times as steep."""
TRYOUT = 1
"""Rounds of each start before the best is gone on with."""

Effects = tuple[type[Effect], ...]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class CandidateFit:
    """A model with effects, fitted on the fit split.

    Attributes:
        effects: The effects added.
        fitted: The fit.
        fit_J: Mean square of the whitened residuals on the fit split; 1 is the floor.
        rank_J: The same on the rank split.
        squares: Sum of squares on the rank split, block by block.
        fit_squares: The same on the fit split.
        fit_blocks: Mean squares of the fit split, block by block.
        rank_blocks: The same of the rank split.
    """

    effects: Effects
    fitted: WhitenedFit
    fit_J: float
    rank_J: float
    squares: FloatArray
    fit_squares: FloatArray
    fit_blocks: Blocks
    rank_blocks: Blocks

    @property
    def values(self) -> dict[str, float]:
        """The values by name."""
        return self.fitted.predictor.values(self.fitted.values)


class ModelFitter:
    """Fits models with effects to the records, and judges them on the other splits.

    Attributes:
        model: The model as given.
        measurements: The records.
        dealt: What each residual entry is used for.
        base: The predictor without effects.
        entries: The entries of each split; where one has none, those before it serve.
    """

    def __init__(
        self, model: DiagnosedModel, measurements: Sequence[MeasuredRecord], floor: NoiseFloor
    ) -> None:
        self.model, self.measurements, self.floor = model, tuple(measurements), floor
        self._predictors: dict[Effects, Predictor] = {}
        self.base = self.predictor(())
        self.split: DataSplit = split_data(measurements, self.base.index)
        self.entries = {FIT: self.split.where(FIT)}
        for split, before in ((RANK, (FIT,)), (REPORT, (FIT, RANK))):
            own = self.split.where(split)
            self.entries[split] = own if own.size else self.split.where(*before)

    @property
    def scale(self) -> RecordScale:
        """What sizes of effects are measured against."""
        angle_rad, tension_N = self.floor.angle_rad, self.floor.tension_N
        model = self.model.calibrated({})
        given = pull_N_rad(model, self.measurements)
        if math.isnan(angle_rad):
            # Without an encoder the gauge tells how far the drum has turned.
            angle_rad = tension_N / float(np.median(given))
        stretched = [
            float(m.tension_N.max()) / pull * model.drum_radius_m
            for m, pull in zip(self.measurements, given, strict=True)
            if m.tension_N is not None and math.isfinite(pull)
        ]
        read = [float(m.tension_N.max()) for m in self.measurements if m.tension_N is not None]
        turned = [float(np.ptp(m.angle_rad)) for m in self.measurements if m.angle_rad is not None]
        turned = turned or [
            float(np.ptp(m.tension_N)) / pull
            for m, pull in zip(self.measurements, given, strict=True)
            if m.tension_N is not None and math.isfinite(pull)
        ]
        return RecordScale(
            sample_s=1.0 / min(m.sampling_Hz for m in self.measurements),
            angle_noise_rad=angle_rad,
            tension_noise_N=tension_N,
            reading_max_N=max(read, default=math.nan),
            stretch_max_m=max(stretched, default=math.nan),
            turn_periods=2.0 * math.pi / max(*turned, 1e-9) if turned else math.nan,
        )

    def predictor(self, effects: Effects) -> Predictor:
        """The model with effects, compiled once."""
        if effects not in self._predictors:
            self._predictors[effects] = Predictor(
                self.model, effects, self.measurements, floor=self.floor
            )
        return self._predictors[effects]

    def attempt(
        self,
        effects: Effects,
        starts: FloatArray,
        rounds: int = 15,
        owners: frozenset[str] | None = None,
    ) -> CandidateFit:
        """The best fit of a model from several starts.

        Args:
            effects: The effects added.
            starts: Rows of values, shape (starts, free).
            rounds: Most rounds of each fit.
            owners: Whose values, or which by name, may move besides those of single records; None
                is all.
        """
        predictor = self.predictor(effects)
        moves = self.moves(predictor)
        if owners is not None:
            free = predictor.free
            moves = np.array(
                [
                    n
                    for n in moves
                    if {free[n].owner, free[n].name} & owners or _record(free[n].owner) is not None
                ],
                dtype=np.int64,
            )
        entries, best = self.entries[FIT], starts[0]
        if len(starts) > 1:
            begun = [fit(predictor, row, moves, entries, TRYOUT) for row in starts]
            best = min(begun, key=lambda f: f.mean_square).values
        return self._judged(effects, fit(predictor, best, moves, entries, rounds))

    def switched_on(
        self, predictor: Predictor, rows: FloatArray, size: int, step: float
    ) -> FloatArray:
        """Rows with a value that does nothing switched on; see `fit.switched_on`."""
        moves = self.moves(predictor)
        return switched_on(predictor, rows, size, step, moves=moves, entries=self.entries[FIT])

    def best_starts(self, predictor: Predictor, rows: FloatArray, most: int) -> FloatArray:
        """The rows of values that leave the least on the fit split."""
        found = predictor.residuals(rows, self.entries[FIT])
        best: FloatArray = rows[np.einsum("ij,ij->i", found, found).argsort()[:most]]
        return best

    def placed(self, predictor: Predictor, rows: FloatArray) -> FloatArray:
        """Rows with each fitted record's own values moved to where the residuals are least."""
        return self._placed(predictor, rows, self.moves(predictor), self.entries[FIT])

    def _placed(
        self, predictor: Predictor, rows: FloatArray, moves: Numbers, entries: Numbers
    ) -> FloatArray:
        """Rows with each record's own values moved to where the residuals are least.

        An effect that bends the cable's law shifts the angle at which it is taut, further than
        a fit from elsewhere finds back.

        Args:
            predictor: The model.
            rows: Values, shape (rows, free).
            moves: Numbers of the values that may move.
            entries: Numbers of the entries that tell.
        """
        rows = self._turned(predictor, rows, moves, entries)
        bends = {Port.CABLE, Port.EYELET}
        if not any(bends & set(effect.ports()) for effect in self.effects_of(predictor)):
            return rows
        kinds: dict[str, dict[int, int]] = {}
        for n in moves.tolist():
            f = predictor.free[n]
            record = _record(f.owner)
            if record is not None:
                kinds.setdefault(f.name.partition("[")[0], {})[record] = n
        for own in kinds.values():
            records, places = np.array(list(own)), np.array(list(own.values()))
            mine = entries[np.isin(predictor.index.measurement[entries], records)]
            found, first = np.unique(predictor.index.measurement[mine], return_index=True)
            _, slope = predictor.linearise(rows[0], places, mine)
            steepness = np.sqrt(np.einsum("ij,ij->j", slope, slope) / mine.size)
            if not steepness.all():
                continue
            shifted = np.repeat(rows, SHIFTS.size, axis=0)
            shifted[:, places] += np.tile(SHIFTS, len(rows))[:, None] / steepness
            squares = np.add.reduceat(predictor.residuals(shifted, mine) ** 2, first, axis=1)
            best = squares.reshape(len(rows), SHIFTS.size, -1).argmin(axis=1)
            rows = rows.copy()
            rows[:, places] += SHIFTS[best[:, np.searchsorted(found, records)]] / steepness
        return rows

    def _turned(
        self, predictor: Predictor, rows: FloatArray, moves: Numbers, entries: Numbers
    ) -> FloatArray:
        """Rows with each record's zero of the angle where a wave over it leaves the least.

        Only where nothing but the wave tells the zero.

        Args:
            predictor: The model.
            rows: Values, shape (rows, free).
            moves: Numbers of the values that may move.
            entries: Numbers of the entries that tell.
        """
        known, free = {f.name for f in self.base.free}, predictor.free
        places = {
            record: n
            for n in moves.tolist()
            if (record := _record(free[n].owner)) is not None and free[n].name not in known
        }
        waves = {
            f"{e.name}.{name}"
            for e in self.effects_of(predictor)
            for name in e.named(Role.PERIODS)
        }
        repeats = [n for n, f in enumerate(free) if f.name in waves]
        if not places or not repeats:
            return rows
        period = 2.0 * math.pi / rows[:, repeats[-1]]
        records, columns = np.array(list(places)), np.array(list(places.values()))
        mine = entries[np.isin(predictor.index.measurement[entries], records)]
        found, first = np.unique(predictor.index.measurement[mine], return_index=True)
        turned = np.repeat(rows, TURNS.size, axis=0)
        turned[:, columns] += np.outer(period, TURNS).reshape(-1, 1)
        squares = np.add.reduceat(predictor.residuals(turned, mine) ** 2, first, axis=1)
        best = squares.reshape(len(rows), TURNS.size, -1).argmin(axis=1)
        rows = rows.copy()
        rows[:, columns] += TURNS[best[:, np.searchsorted(found, records)]] * period[:, None]
        return rows

    def refine(self, attempt: CandidateFit, rounds: int = 15) -> CandidateFit:
        """The same, fitted to the end, or for some rounds."""
        f = attempt.fitted
        if f.converged:
            return attempt
        return self._judged(
            attempt.effects, fit(f.predictor, f.values, f.moved, self.entries[FIT], rounds)
        )

    def _judged(self, effects: Effects, found: WhitenedFit) -> CandidateFit:
        held = self.settled(found, RANK)
        return CandidateFit(
            *(effects, found, found.mean_square, held.mean_square),
            *(self._squares(held), self._squares(found)),
            *(Blocks.of(self.cable_block(at), at.residuals) for at in (found, held)),
        )

    def _squares(self, found: WhitenedFit) -> FloatArray:
        """Sum of squares, block by block."""
        _, block = np.unique(self.split.group[found.entries], return_inverse=True)
        squares: FloatArray = np.bincount(block, found.residuals**2).astype(np.float64)
        return squares

    def cable_block(self, found: WhitenedFit) -> CableBlock | None:
        """The cable and gauge block of the entries of a fit; None without gauge or encoder."""
        values = found.predictor.values(found.values)
        pull = pull_N_rad(self.model.calibrated(values), self.measurements)
        return CableBlock.of(found.predictor.index, found.entries, pull)

    def settled(self, found: WhitenedFit, split: int) -> WhitenedFit:
        """A fit held against a split, the held-out records' own values fitted to it."""
        predictor, entries = found.predictor, self.entries[split]
        moves = self._own(predictor, split)
        own = entries[np.isin(predictor.index.measurement[entries], list(self.split.records))]
        if moves.size:
            rows = found.values[None, :]
            for _ in range(PLACINGS):
                before, rows = rows, self._placed(predictor, rows, moves, own)
                if np.array_equal(before, rows):
                    break
            found = replace(found, values=rows[0])
        return settled(found, moves, own, entries)

    def final(self, attempt: CandidateFit) -> WhitenedFit:
        """The same model fitted to the fit and the rank split together."""
        predictor = attempt.fitted.predictor
        entries = self.split.where(FIT, RANK)
        moves = np.union1d(attempt.fitted.moved, self._own(predictor, RANK))
        return fit(predictor, self.settled(attempt.fitted, RANK).values, moves, entries)

    def effects_of(self, predictor: Predictor) -> Effects:
        """The effects a predictor adds."""
        return next(e for e, p in self._predictors.items() if p is predictor)

    def free_run(self, fitted: WhitenedFit) -> list[Prediction]:
        """Each record from its start, with nothing put right on the way."""
        effects = self.effects_of(fitted.predictor)
        values = fitted.predictor.values(self.settled(fitted, REPORT).values)
        running = Predictor(self.model, effects, self.measurements, None, self.floor)
        known = {f.name for f in running.free}
        row = running.row({name: value for name, value in values.items() if name in known})
        return running.predict(row[None, :])

    def moves(self, predictor: Predictor) -> Numbers:
        """Numbers of the values that the fit split can tell."""
        measured = set(np.unique(predictor.index.measurement[self.entries[FIT]]).tolist())
        return np.array(
            [n for n, f in enumerate(predictor.free) if _record(f.owner) in {None, *measured}],
            dtype=np.int64,
        )

    def _own(self, predictor: Predictor, split: int) -> Numbers:
        """Numbers of the values that belong to held-out records of a split."""
        measured = set(np.unique(predictor.index.measurement[self.entries[split]]).tolist())
        wanted = measured & self.split.records
        return np.array(
            [n for n, f in enumerate(predictor.free) if _record(f.owner) in wanted], dtype=np.int64
        )


def _record(owner: str) -> int | None:
    """Number of the record that a free value belongs to, or None."""
    return int(owner.removeprefix("record ")) if owner.startswith("record ") else None
