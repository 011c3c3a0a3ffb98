"""The evidence beside a verdict: gaps on the report split, intervals, parameter shifts, traces."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from plants.diagnosis.data.measured_record import OUTPUTS
from plants.diagnosis.models.diagnosed_model import BASE
from plants.diagnosis.prediction.prediction import CHANNELS, Predictor
from plants.diagnosis.result import BaseParameter, Interval, Trace
from plants.diagnosis.search.data_splits import REPORT
from plants.diagnosis.search.fit import WhitenedFit, covariance
from plants.diagnosis.search.model_fitter import ModelFitter

UNITS = {"tension_N": "N", "angle_rad": "rad", "reference_N": "N", "current_A": "A"}

STUDENT = 2.6
"""Half the width of a 95 % interval in standard errors. That of Student's distribution with six
degrees of freedom, about as many as there are records that err together, is 2.45."""
MODEL_FORM = 0.03
"""Least share of a parameter by which a law that is not quite the machine's may shift it."""
TAKEN_UP = 0.3
"""Share by which it may, per share of the gap that the law leaves: parameters take up some of what
a law cannot explain."""


class TestError(NamedTuple):
    """How well one model does on the report split.

    Attributes:
        ratio: Root mean square of the whitened residuals of short predictions; 1 is the floor.
        floor: Root mean square of sigma_eff of the first output, in its unit.
    """

    ratio: float
    floor: float

    @property
    def gap(self) -> float:
        """The gap of all channels, told in the unit of the first output."""
        return self.ratio * self.floor


def reported(bench: ModelFitter, fitted: WhitenedFit) -> TestError:
    """The gap of a fit on the report split."""
    entries = bench.entries[REPORT]
    at = bench.settled(fitted, REPORT)
    index = fitted.predictor.index
    first = [CHANNELS.index(name) for name in OUTPUTS if UNITS[name] == bench.model.output]
    sigma = index.sigma[entries][np.isin(index.channel[entries], first)]
    floor = float(np.sqrt(np.mean(sigma**2))) if sigma.size else math.nan
    return TestError(math.sqrt(at.mean_square), floor)


def intervals(bench: ModelFitter, fitted: WhitenedFit, base: WhitenedFit) -> dict[str, Interval]:
    """Values and 95 % confidence intervals of all that is shared by the records.

    Residuals are coloured, and those of one record err together: the covariance is the larger of
    those with blocks of time and with records as the groups that belong together.
    """
    index = fitted.predictor.index
    blocks = covariance(fitted, bench.split.group[fitted.entries])
    records = covariance(fitted, index.measurement[fitted.entries])
    variance = np.maximum(np.diag(blocks), np.diag(records))
    left = max(fitted.mean_square - 1.0, 0.0) / max(base.mean_square, 1e-300)
    share = max(MODEL_FORM, TAKEN_UP * math.sqrt(min(left, 1.0)))
    found = {}
    for place, n in enumerate(fitted.moved.tolist()):
        free = fitted.predictor.free[n]
        if free.owner.startswith("record "):
            continue
        value = float(fitted.values[n])
        # A limit is neutral far up, a ratio at one: what counts is the nearer of that and zero.
        form = share * min(abs(value - (free.neutral or 0.0)), abs(value))
        half = STUDENT * math.hypot(math.sqrt(max(float(variance[place]), 0.0)), form)
        if free.scale == "log" and value > 0.0 and half < value * 5.0:
            factor = math.exp(half / value)
            low, high = value / factor, value * factor
        else:
            low, high = value - half, value + half
        low, high = max(low, free.low), min(high, free.high)
        found[free.name] = Interval(value, low, high, free.unit)
    return found


def calibrations(
    predictor: Predictor,
    base: Mapping[str, Interval],
    with_effects: Mapping[str, Interval],
) -> tuple[BaseParameter, ...]:
    """The base model's numbers as given, as fitted, and as fitted with the effects."""
    return tuple(
        BaseParameter(
            f.name, f.unit, f.start, base[f.name], with_effects.get(f.name, base[f.name])
        )
        for f in predictor.free
        if f.owner == BASE and f.name in base
    )


class FreeRun(NamedTuple):
    """Free runs of the records that have a part in the report split.

    Attributes:
        traces: Channel by channel.
        rms_before: Error of the base model over the report parts, in the first output's unit.
        rms_after: That of the model with effects.
    """

    traces: tuple[Trace, ...]
    rms_before: float
    rms_after: float


def free_run(
    before: tuple[ModelFitter, WhitenedFit], after: tuple[ModelFitter, WhitenedFit]
) -> FreeRun:
    """Runs the records of the report split from their start, with nothing put right on the way.

    Args:
        before: Records and base model.
        after: Records and model with effects; records without hum are held against as they are.
    """
    runs = [bench.free_run(fitted) for bench, fitted in (before, after)]
    bench, cleaned = before[0], after[0]
    main, index = main_channel(bench), bench.base.index
    entries = bench.entries[REPORT]
    traces, errors = [], []
    for n in sorted(set(index.measurement[entries].tolist())):
        m = bench.measurements[n]
        for name in OUTPUTS:
            measured, rest = m.channel(name), cleaned.measurements[n].channel(name)
            before_run, after_run = (getattr(run[n], name) for run in runs)
            if measured is None or rest is None or before_run is None or after_run is None:
                continue
            # What was taken out as hum belongs to what is predicted with it.
            known = after_run[0] + (measured - rest)
            one = Trace(m.name, name, UNITS[name], m.time_s, measured, before_run[0], known)
            traces.append(one)
            if name == main:
                mine = (index.measurement == n) & (index.channel == CHANNELS.index(name))
                inside = index.sample[np.intersect1d(np.flatnonzero(mine), entries)]
                errors.append(np.stack([one.before - measured, one.after - measured])[:, inside])
    rms = np.sqrt(np.mean(np.concatenate(errors, axis=1) ** 2, axis=1))
    return FreeRun(tuple(traces), float(rms[0]), float(rms[1]))


def main_channel(bench: ModelFitter) -> str:
    """The first output that is measured."""
    measured = {name for m in bench.measurements for name in m.outputs}
    return next(n for n in OUTPUTS if n in measured and UNITS[n] == bench.model.output)
