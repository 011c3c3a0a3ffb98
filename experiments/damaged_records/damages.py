"""The ways in which records are damaged, or are not what they are taken for."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from experiments.damaged_records.machines import Table

Damage = Callable[[Table, np.random.Generator], Table]


def _time(table: Table) -> str:
    return next(iter(table))


def _kept(table: Table, rows: NDArray[np.intp]) -> Table:
    return {name: values[rows] for name, values in table.items()}


def _any(table: Table, rng: np.random.Generator, *, time: bool = False) -> str:
    return str(rng.choice(list(table)[0 if time else 1 :]))


def _stretch(table: Table, rng: np.random.Generator, most: float = 0.3) -> tuple[int, int]:
    """First and last row of a piece of a record."""
    rows = table[_time(table)].size
    length = int(rng.integers(1, max(2, round(most * rows))))
    first = int(rng.integers(0, rows - length + 1)) if rows > length else 0
    return first, min(first + length, rows)


def cut(table: Table, rng: np.random.Generator) -> Table:
    """The end is missing, up to all but a few rows; the rest may begin in motion."""
    rows = table[_time(table)].size
    kept = int(rows ** rng.uniform(0.0, 1.0))
    first = int(rng.integers(0, rows - kept + 1))
    return _kept(table, np.arange(first, first + kept))


def started_in_motion(table: Table, rng: np.random.Generator) -> Table:
    """The first part is missing."""
    return _kept(table, np.arange(_stretch(table, rng, 0.6)[1] // 2, table[_time(table)].size))


def gapped(table: Table, rng: np.random.Generator) -> Table:
    """Rows are missing in one gap to forty, of any length and spacing."""
    keep = np.ones(table[_time(table)].size, bool)
    for _ in range(int(40.0 ** rng.uniform(0.0, 1.0))):
        first, last = _stretch(table, rng, 0.05)
        keep[first:last] = False
    return _kept(table, np.flatnonzero(keep))


def jittered(table: Table, rng: np.random.Generator) -> Table:
    """The stamps scatter by up to 60 % of a sample."""
    t = table[_time(table)]
    steps = np.diff(t, append=2.0 * t[-1] - t[-2])
    return table | {_time(table): t + steps * rng.uniform(0.0, 0.6) * rng.uniform(-1, 1, t.size)}


def rounded_stamps(table: Table, rng: np.random.Generator) -> Table:
    """The stamps have one to four decimals."""
    return table | {_time(table): np.round(table[_time(table)], int(rng.integers(1, 5)))}


def another_rate(table: Table, rng: np.random.Generator) -> Table:
    """The clock is up to 2 % fast or slow."""
    return table | {_time(table): table[_time(table)] * (1.0 + rng.uniform(-0.02, 0.02))}


def another_clock(table: Table, rng: np.random.Generator) -> Table:
    """The time is in another unit, begins elsewhere, or starts again in the middle."""
    t = table[_time(table)]
    match int(rng.integers(4)):
        case 0:
            t = t * float(rng.choice([1e3, 1e6, 1e-3]))
        case 1:
            t = t + 1.7e9
        case 2:
            t = np.where(np.arange(t.size) < t.size // 2, t, t - t[t.size // 2])
        case _:
            t = t[::-1]
    return table | {_time(table): t}


def scaled(table: Table, rng: np.random.Generator) -> Table:
    """A column is in another unit, or of the other sign."""
    name = _any(table, rng)
    factors = (-1.0, 1e3, 1e-3, 180.0 / np.pi, 1e12, 1e-12, 1e200, 1e-200)
    return table | {name: table[name] * float(rng.choice(factors))}


def clipped(table: Table, rng: np.random.Generator) -> Table:
    """A column is cut at a quantile."""
    name = _any(table, rng)
    low, high = np.nanquantile(table[name], sorted(rng.uniform(0.0, 1.0, 2)))
    return table | {name: np.clip(table[name], low, high)}


def constant(table: Table, rng: np.random.Generator) -> Table:
    """A column stands still, whole or for a stretch."""
    name = _any(table, rng, time=True)
    first, last = _stretch(table, rng, 1.0) if rng.random() < 0.5 else (0, table[name].size)
    values = table[name].copy()
    values[first:last] = values[first]
    return table | {name: values}


def swapped(table: Table, rng: np.random.Generator) -> Table:
    """Two columns have each other's name."""
    one, two = (str(n) for n in rng.choice(list(table), 2, replace=False))
    return table | {one: table[two], two: table[one]}


def not_a_number(table: Table, rng: np.random.Generator) -> Table:
    """Cells are NaN or infinite."""
    name = _any(table, rng, time=True)
    values = table[name].copy()
    number = int(values.size ** rng.uniform(0.0, 1.0))
    values[rng.choice(values.size, number, replace=False)] = rng.choice([np.nan, np.inf])
    return table | {name: values}


def duplicated(table: Table, rng: np.random.Generator) -> Table:
    """Rows stand twice, each beside itself or a piece once more at the end."""
    rows = np.arange(table[_time(table)].size)
    first, last = _stretch(table, rng)
    if rng.random() < 0.5:
        return _kept(table, np.sort(np.concatenate([rows, rows[first:last]])))
    return _kept(table, np.concatenate([rows, rows[first:last]]))


def resting(table: Table, rng: np.random.Generator) -> Table:
    """The motor rests: nothing moves for a long time, before or after."""
    rows = np.arange(table[_time(table)].size)
    more = int(rng.integers(1, 3 * rows.size))
    before = bool(rng.random() < 0.5)
    held = np.full(more, 0 if before else rows[-1])
    order = np.concatenate([held, rows] if before else [rows, held])
    t = table[_time(table)]
    even = t[0] + np.arange(order.size) * float(np.median(np.diff(t)))
    return _kept(table, order) | {_time(table): even}


def speeds(table: Table, _rng: np.random.Generator) -> Table:
    """The last column, a position or tension, is its rate."""
    name = list(table)[-1]
    return table | {name: np.gradient(table[name], table[_time(table)])}


def another_effort(table: Table, rng: np.random.Generator) -> Table:
    """The command is a current, a duty or a voltage that the motor's speed adds to."""
    name = list(table)[1 if len(table) < 5 else 2]
    gain = 10.0 ** rng.uniform(-2.0, 2.0)
    speed = np.gradient(list(table.values())[-1], table[_time(table)])
    return table | {name: gain * (table[name] + rng.uniform(0.0, 0.5) * speed)}


def another_mode(table: Table, rng: np.random.Generator) -> Table:
    """In a stretch the command is off, or another quantity."""
    name = list(table)[1 if len(table) < 5 else 2]
    first, last = _stretch(table, rng, 0.7)
    values = table[name].copy()
    off = rng.random() < 0.5
    values[first:last] = 0.0 if off else list(table.values())[-1][first:last]
    return table | {name: values}


DAMAGES: dict[str, Damage] = {
    d.__name__: d
    for d in (
        *(cut, started_in_motion, gapped, jittered, rounded_stamps, another_rate, another_clock),
        *(scaled, clipped, constant, swapped, not_a_number, duplicated, resting, speeds),
        *(another_effort, another_mode),
    )
}
"""All of them by name."""
