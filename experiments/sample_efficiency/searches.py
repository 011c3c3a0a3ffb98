"""One search, an algorithm on a problem, and its stored row."""

import contextlib
import json
import math
import time
import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.sample_efficiency.algorithms import ALGORITHMS
from experiments.sample_efficiency.optimum import optimum
from experiments.sample_efficiency.trials import Job, Spent, Trials

NEAR = 0.05
"""Excess cost at which a search has arrived at the optimum."""


@dataclass(frozen=True, slots=True)
class SearchRow:
    """The result of a search.

    Attributes:
        job: The settings.
        excess: Noise-free cost of the recommended gains after each trial, over that of the
            optimum, less one.
        unsafe: Number of unsafe trials.
        seconds: Duration, simulated trials included.
    """

    job: Job
    excess: tuple[float, ...]
    unsafe: int
    seconds: float

    @property
    def first_near(self) -> float:
        """Trials until the recommended gains are near the optimum; infinite if never."""
        return next((k for k, e in enumerate(self.excess, 1) if e <= NEAR), math.inf)

    @property
    def stays_near(self) -> float:
        """Trials from which on they stay near; infinite if they do not."""
        far = [k for k, e in enumerate(self.excess, 1) if not e <= NEAR]
        last = far[-1] if far else 0
        return last + 1 if last < len(self.excess) else math.inf

    def excess_after(self, trials: int) -> float:
        """The excess after a number of trials."""
        return self.excess[trials - 1]


def search(job: Job) -> SearchRow:
    """Runs a search."""
    trials = Trials(job)
    began = time.perf_counter()
    # Warnings of the libraries do not concern the comparison.
    with contextlib.suppress(Spent), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ALGORITHMS[job.algorithm](trials)
    seconds = time.perf_counter() - began
    excess = trials.settled_costs() / optimum(trials.problem).cost - 1.0
    return SearchRow(job, tuple(np.round(excess, 6).tolist()), trials.unsafe, round(seconds, 3))


def add(row: SearchRow, file: Path) -> None:
    """Adds a row to a file."""
    with file.open("a", encoding="utf-8") as rows:
        rows.write(f"{json.dumps(asdict(row))}\n")


def read(file: Path) -> list[SearchRow]:
    """The rows of a file; none where there is no file."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [_row(**json.loads(line)) for line in lines]


def _row(job: dict[str, Any], excess: list[float], **others: Any) -> SearchRow:
    return SearchRow(Job(**job), tuple(excess), **others)


def select(rows: Iterable[SearchRow], **values: object) -> list[SearchRow]:
    """The rows whose jobs have these values, in the order of their seeds."""
    matching = [r for r in rows if all(getattr(r.job, k) == v for k, v in values.items())]
    return sorted(matching, key=lambda row: row.job.seed)
