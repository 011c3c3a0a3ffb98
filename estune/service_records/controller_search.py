"""The controller that explains a logged effort with the fewest changes from the one stated."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray

FITS = 0.005
"""Residual, over the range of the effort, up to which the effort is explained. Eleven logs of a
heated chamber leave 0.01 to 0.10 % with the gains that ran, 4.7 % with a P stated as 4 that was 3,
and 6 to 12 % with a time scale of the integral that is wrong."""

SURE = 0.0005
"""Residual up to which nothing else is tried: a derivative filter of 2 s for one of 5 s leaves
0.2 %, and a D that is 15 % off."""

AS_WELL = 2.0
"""Ratio of two residuals up to which both explain the effort."""

FILTERS = 25
"""Time constants of a filter that are tried, evenly in the logarithm."""

Measure = Callable[[ControllerSettings, float], tuple[float, FloatArray]]
"""Error and gains for one controller and one time constant of the setpoint filter."""


def least_changed(
    best: Measure,
    by_part: Measure,
    settings: ControllerSettings,
    tau: float,
    longest_s: float,
    *,
    moves: bool,
) -> tuple[float, FloatArray, ControllerSettings, float]:
    """Error, gains, controller and setpoint filter: the fewest changes that explain the effort.

    Args:
        best: What a controller leaves with the gains of least squares.
        by_part: The same of a part of a long record, by which the filters are sought.
        settings: The controller as stated.
        tau: Time constant of the setpoint filter, as stated.
        longest_s: Length of the longest stretch, which bounds the filters, s.
        moves: Whether the setpoint does.
    """
    tried = [(*best(settings, tau), settings, tau)]
    if _is_sure(tried):
        return tried[-1]
    own = settings.form or ControllerForm()
    on: Literal["measurement", "error"] = (
        "error" if own.derivative_on == "measurement" else "measurement"
    )
    # Of one setpoint neither its filter nor its derivative shows.
    others = (settings.form, replace(own, derivative_on=on)) if moves else (settings.form,)
    rate = settings.sampling_Hz
    for form in others:
        here = replace(settings, form=form)
        by_lag = partial(_with_derivative, by_part, here, tau)
        lagged = _derivative_filter(here, _best_filter(by_lag, rate, longest_s))
        for controller in dict.fromkeys((here, lagged)):  # one where no filter is better
            tried.append((*best(controller, tau), controller, tau))
            if moves:
                slow = _best_filter(partial(by_part, controller), rate, longest_s)
                tried.append((*best(controller, slow), controller, slow))
            if _is_sure(tried):
                return tried[-1]
    least = min(error for error, *_ in tried)
    within = least if least > FITS else min(max(AS_WELL * least, SURE), FITS)
    return next(one for one in tried if one[0] <= within)


def _is_sure(tried: Sequence[tuple[float, FloatArray, ControllerSettings, float]]) -> bool:
    """Whether the last one is that which is chosen, whatever is tried further."""
    return tried[-1][0] <= SURE and all(one[0] > AS_WELL * SURE for one in tried[:-1])


def _with_derivative(
    best: Measure, settings: ControllerSettings, tau: float, lag: float
) -> tuple[float, FloatArray]:
    return best(_derivative_filter(settings, lag), tau)


def _derivative_filter(settings: ControllerSettings, lag: float) -> ControllerSettings:
    """The controller with another derivative filter, by the rule of `pidf`."""
    form = settings.form and replace(settings.form, derivative="backward")
    return replace(settings, form=form, derivative_filter_s=lag)


def _best_filter(
    best: Callable[[float], tuple[float, FloatArray]], sampling_Hz: float, longest_s: float
) -> float:
    """Time constant of a filter that leaves least."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415  slow to import

    grid = np.geomspace(0.2 / sampling_Hz, max(0.1 * longest_s, 2.0 / sampling_Hz), FILTERS)
    error, at = min((best(tau)[0], n) for n, tau in enumerate(grid.tolist()))
    if best(0.0)[0] <= error:
        return 0.0
    logs, ratio = np.log(grid), math.log(grid[1] / grid[0])
    inner = minimize_scalar(
        lambda x: best(math.exp(x))[0],
        bounds=(logs[at] - ratio, logs[at] + ratio),
        method="bounded",
        options={"xatol": 1e-4},
    )
    return math.exp(float(inner.x))
