"""The law in words."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estune.studies.law.gain_fit import GainFit

_CALLED = {"setpoint_filter_s": "the setpoint filter"}
_UNIT = {"P": "", "I": " 1/s", "D": " s", "setpoint_filter_s": " s"}
_DOUBTFUL = 0.05
"""p below which a form is said to miss."""


def sentence(fits: Iterable["GainFit"]) -> str:
    """Each gain's way with length, then what tension does."""
    fits = tuple(fits)
    said = [_along_length(fit) for fit in sorted(fits, key=lambda f: f.shape.form == "constant")]
    return "; ".join([*said, _along_tension(fits)])


def remarks(fits: Iterable["GainFit"], excluded: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    """What was left out, which tunings are outliers, and where a form misses."""
    said = [f"left out: {label}, {why}" for label, why in excluded]
    for fit in fits:
        name = _CALLED.get(fit.name, fit.name)
        said += [f"{name}: {label} is an outlier and hardly counts" for label in fit.outliers]
        lack = fit.lack_of_fit
        if lack is not None and lack.p_value < _DOUBTFUL:
            said.append(
                f"{name}: the {fit.shape} form misses the repeated tunings by more than their "
                f"scatter explains (p = {lack.p_value:.2g}); tune at more lengths"
            )
    return tuple(said)


def _along_length(fit: "GainFit") -> str:
    name, unit = _CALLED.get(fit.name, fit.name), _UNIT[fit.name]
    slope = fit.slope
    doubt = f"±{slope.half_width:.2g}"
    if np.ptp(fit.points.gain) == 0.0:
        return f"{name} is {fit.mean:.4g}{unit} throughout"
    if fit.shape.form == "constant":
        within = "is constant within its error" if not slope.differs else "hardly changes"
        return f"{name} {within} at {fit.mean:.3g}{unit} ({slope.value:+.2g} {doubt} per metre)"
    way = "falls" if slope.value < 0.0 else "rises"
    bent = "" if fit.shape.form == "linear" else f", best as {fit.curve}"
    return f"{name} {way} by {abs(slope.value):.3g} {doubt}{unit} per metre{bent}"


def _along_tension(fits: tuple["GainFit", ...]) -> str:
    effects = [(fit, fit.tension_effect) for fit in fits if fit.tension_effect is not None]
    if not effects:
        return "tension was not varied"
    found = [
        f"{_CALLED.get(fit.name, fit.name)} by {effect.value:+.2g} ±{effect.half_width:.1g}"
        f"{_UNIT[fit.name]}"
        for fit, effect in effects
        if fit.shape.with_tension
    ]
    return (
        f"each N of tension changes {', '.join(found)}"
        if found
        else ("tension has no detectable effect")
    )
