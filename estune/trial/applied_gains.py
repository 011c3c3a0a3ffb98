"""The controller that acted in a trial, from the effort it logged.

The effort follows from setpoint, measurement and gains by the controller's equation, which is
linear in P, I and D and in the step of the setpoint. Where the log is that of other gains, or of
another step, than the record states, so are the response and its cost.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.controller_equation import efforts_by_filter
from estune.core.quantities import FloatArray
from estune.trial.controller_fit import REPRODUCED, known_samples, unfiltered_moves
from estune.trial.description import RigDescription
from estune.trial.loop_records import recomputed_effort
from estune.trial.outcome import Outcome
from estune.trial.records import SATURATED, TrialRecord

RATIO_ERROR = 0.05
"""Error of a ratio of gains that is allowed. With one gain doubled on two rigs of
`experiments.batch` the ratios told are at most 0.3 % off in logs rounded to 1e-3 of the effort's
range. A measurement rounded to 1e-3 of the step makes up to 20 %, another derivative filter up to
410 %: both leave more than `REPRODUCED`, so that nothing is told."""

FILTERS = 60
"""Time constants of the setpoint filter that are tried. Those of three trials, from 3 samples to
two settling times, are found to 1e-4 with 60, and with 10."""

BETTER = 0.25
"""Largest residual of what acted over that of what is stated: another form of the derivative's
filter leaves more than this of it with any gains."""


def applied_fault(record: TrialRecord, rig: RigDescription) -> str:
    """What acted in a trial in place of what its record states; empty where the log agrees.

    Empty, too, where no other gains nor step explain the log to `REPRODUCED`, and where the effort
    was held at a limit.
    """
    logged = record.controller_A * rig.newtons_per_ampere
    if record.outcome is not Outcome.DONE or (record.flags & SATURATED).any():
        return ""
    if not (np.isfinite(logged).all() and np.isfinite(record.tension_N).all()):
        return ""
    moves, whole = np.diff(logged)[known_samples(rig.controller, logged.size)], _moves(record, rig)
    stated, size = float(np.linalg.norm(whole - moves)), float(np.linalg.norm(moves))
    if not size or stated <= REPRODUCED * size:  # a rig may log no effort
        return ""
    names, parts = zip(*_parts(record, rig), strict=True)
    gains = _Explained.by(names, np.array(parts).T, moves)
    level = np.full_like(record.setpoint_N, record.setpoint_N[0])
    rest = _moves(replace(record, setpoint_N=level), rig)
    step = _Explained.by(("the step",), (whole - rest)[:, None], moves - rest)
    explained, most = [gains, step], min(REPRODUCED * size, BETTER * stated)
    # Before the setpoint changes every filter of it leaves the same: to try them takes as long as
    # all the rest of a trial, so it is left out where that is too much already.
    if float(np.linalg.norm((whole - moves)[: unfiltered_moves(record, rig.controller)])) <= most:
        explained.append(_by_filter(record, rig, moves))
    best = min(explained, key=lambda one: one.left)
    return "" if best.left > most else best.sentence(record)


class _Explained(NamedTuple):
    """What explains a log: factors of what was stated.

    Attributes:
        left: Norm of what is left of the increments.
        ratios: Factors by name.
    """

    left: float
    ratios: dict[str, float]

    @classmethod
    def by(cls, names: Sequence[str], columns: FloatArray, moves: FloatArray) -> "_Explained":
        """Factors of columns, shape (samples, n), by least squares."""
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        ratios = np.linalg.lstsq(columns / size, moves, rcond=None)[0] / size
        left = float(np.linalg.norm(columns @ ratios - moves))
        return cls(left, dict(zip(names, ratios.tolist(), strict=True)))

    def sentence(self, record: TrialRecord) -> str:
        """What acted; empty where nothing differs by more than may be."""
        off = {n: ratio for n, ratio in self.ratios.items() if abs(ratio - 1.0) > RATIO_ERROR}
        values = [*off.values()]
        if 1 < len(off) == len(self.ratios) and np.ptp(values) < RATIO_ERROR * np.mean(values):
            off = {"P, I and D" if len(off) > 2 else " and ".join(off): float(np.mean(values))}
        what = " and ".join(f"{ratio:.3g} times {name}" for name, ratio in off.items())
        return f"its logged effort is that of {what} as stated ({record.gains})" if off else ""


def _by_filter(record: TrialRecord, rig: RigDescription, moves: FloatArray) -> _Explained:
    """The log by a setpoint filter of another time constant, from a sample to the whole trial."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415  slow to import

    rate, stated_s = record.sampling_Hz, record.gains.setpoint_filter_s
    efforts = efforts_by_filter(
        rig.controller, record.gains, record.setpoint_N, record.tension_N, first_effort=0.0
    )
    known = known_samples(rig.controller, record.setpoint_N.size)

    def left(logarithm: float) -> float:
        return float(np.linalg.norm(np.diff(efforts(math.exp(logarithm)))[known] - moves))

    tried = np.linspace(-math.log(rate), math.log(moves.size / rate), FILTERS)
    at = int(np.argmin([left(one) for one in tried]))
    ends = tried[max(at - 1, 0)], tried[min(at + 1, FILTERS - 1)]
    found = minimize_scalar(left, bounds=ends, method="bounded", options={"xatol": 1e-4})
    ratio = math.exp(found.x) / (stated_s or 1.0 / rate)
    name = "the setpoint filter" if stated_s else "a setpoint filter of one sample"
    return _Explained(float(found.fun), {name: ratio})


def _parts(record: TrialRecord, rig: RigDescription) -> Iterator[tuple[str, FloatArray]]:
    """The part of the effort's increments by each gain that is not zero."""
    whole = _moves(record, rig)
    for name in ("P", "I", "D"):
        if gain := getattr(record.gains, name):
            twice = replace(record, gains=replace(record.gains, **{name: 2.0 * gain}))
            yield name, _moves(twice, rig) - whole


def _moves(record: TrialRecord, rig: RigDescription) -> FloatArray:
    """Increments of the effort that follows from a record, where the filter knows no past."""
    effort = recomputed_effort(record, rig, 0.0)
    return np.asarray(np.diff(effort)[known_samples(rig.controller, effort.size)])
