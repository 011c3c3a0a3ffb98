"""Law of tuned gains over cable length and tension: the paper's adaptive law, with intervals.

The paper regresses the integral gain on the cable length, I = a + b L, and finds it falling
(Fig. 14). `fit_law` does so for each gain, and also considers the forms of
`estune.studies.law.model_selection`.

A stated slope is that of the straight line, which is fitted whatever form is selected, so that its
interval is not narrowed by the selection. Bands are those of the selected form, given that form.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from estune.core.comparison import interval_factor
from estune.core.gains import GAIN_NAMES, GAIN_UNITS
from estune.core.quantities import BoolArray, FloatArray
from estune.core.schedule import GainSchedule
from estune.errors import InvalidInput
from estune.studies.law.gain_fit import GainFit, fit_gain
from estune.studies.law.model_selection import parse_form
from estune.studies.law.tuned import TunedGains, tuned_columns
from estune.support.lazy_sequence import LazySequence
from estune.trial.signals import REEL, Signals

_NAMES = {"setpoint_filter_s": "the setpoint filter"}
LISTED_MAX = 10
"""Excluded tunings that are named one by one; more of them are only counted."""

_LACK_OF_FIT_P = 0.05
"""p value of the lack-of-fit test below which a remark warns of it."""


class GainBand(NamedTuple):
    """A gain by the law at some lengths; arrays of their shape.

    Attributes:
        low: Lower end of the confidence band of the curve.
        new_low: Lower end of the prediction band, in which one further tuning would lie.
        extrapolated: Whether the length or tension lies beyond the tuned range.
    """

    gain: FloatArray
    low: FloatArray
    high: FloatArray
    new_low: FloatArray
    new_high: FloatArray
    extrapolated: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class GainLaw:
    """The fits of all four gains."""

    fits: Mapping[str, GainFit]
    tunings: Sequence[TunedGains]
    excluded: tuple[tuple[str, str], ...]
    length_m: tuple[float, float]
    tension_N: tuple[float, float]
    signals: Signals = REEL

    @property
    def sentence(self) -> str:
        """The dependence of each gain on length, then on tension, with 95 % intervals."""
        fits = sorted(self.fits.values(), key=lambda fit: fit.form.over_length == "constant")
        parts = [_over_length(fit, _unit(self, fit)) for fit in fits]
        return "; ".join([*parts, _over_tension(self)])

    @property
    def remarks(self) -> tuple[str, ...]:
        """Warnings: excluded tunings, outliers, and forms that do not fit."""
        remarks = [f"left out: {label}, {reason}" for label, reason in self.excluded]
        if len(remarks) > LISTED_MAX:
            counts = Counter(reason for _, reason in self.excluded)
            remarks = [f"left out: {count} tunings, {reason}" for reason, count in counts.items()]
        for fit in self.fits.values():
            name = _NAMES.get(fit.name, fit.name)
            remarks += [f"{name}: {label} is an outlier, down-weighted" for label in fit.outliers]
            lack = fit.lack_of_fit
            if lack is not None and _is_rejected(fit):
                remarks.append(
                    f"{name}: the {fit.form} form does not fit the repeated tunings within their "
                    f"variation (p = {lack.p_value:.2g}); tune at more lengths"
                )
        return tuple(remarks)

    def band(
        self,
        name: str,
        length_m: ArrayLike,
        tension_N: float | None = None,
        *,
        level: float = 0.95,
        extrapolate: bool = False,
    ) -> GainBand:
        """One gain over lengths, with its confidence and prediction bands.

        Args:
            name: The gain, of `GAIN_NAMES`.
            length_m: Cable lengths, m, any shape.
            tension_N: Tension, N; by default the middle of the tuned range.
            level: Level of the bands, between 0 and 1.
            extrapolate: Whether lengths and tensions beyond the tuned range are allowed; the band
                marks them.

        Raises:
            InvalidInput: there is no such gain, the level is not between 0 and 1, or a length or
                tension is beyond the tuned range without `extrapolate`.
        """
        if name not in self.fits:
            raise InvalidInput(f"there is no gain {name!r}; the gains are {', '.join(self.fits)}")
        length = np.asarray(length_m, dtype=np.float64)
        tension = np.full_like(
            length, sum(self.tension_N) / 2.0 if tension_N is None else tension_N
        )
        outside = ~(_within(length, self.length_m) & _within(tension, self.tension_N))
        if outside.any() and not extrapolate:
            raise InvalidInput(
                f"the law holds from {self.length_m[0]:g} to {self.length_m[1]:g} m and "
                f"{self.tension_N[0]:g} to {self.tension_N[1]:g} N; {length[outside].flat[0]:g} m "
                f"at {tension[outside].flat[0]:g} N is beyond: tune there too, or set "
                "extrapolate=True"
            )
        form, fit = self.fits[name].form, self.fits[name].fit
        rows = form.design(length, tension)
        variance = np.einsum("...i,ij,...j", rows, fit.covariance, rows)
        new = variance + float(np.median(fit.deviations)) ** 2
        t, value = interval_factor(fit.degrees, level), rows @ fit.coefficients
        width, new_width = t * np.sqrt(variance), t * np.sqrt(new)
        return GainBand(
            value, value - width, value + width, value - new_width, value + new_width, outside
        )

    def schedule(self) -> GainSchedule:
        """The law as a gain schedule over the tuned range.

        Raises:
            InvalidInput: a form given by the caller falls below zero within the range.
        """
        curves = {name: fit.curve for name, fit in self.fits.items()}
        return GainSchedule(**curves, length_m=self.length_m, tension_N=self.tension_N)

    def to_json(self) -> dict[str, Any]:
        """The law as JSON values."""
        return {
            "sentence": self.sentence,
            "remarks": list(self.remarks),
            "schedule": self.schedule().as_dict(),
            "fits": {name: fit.to_json() for name, fit in self.fits.items()},
            "excluded": [{"label": label, "reason": reason} for label, reason in self.excluded],
        }


def fit_law(
    tunings: Sequence[TunedGains],
    *,
    forms: Mapping[str, str] | None = None,
    signals: Signals = REEL,
) -> GainLaw:
    """Fits the law to tunings at different lengths.

    Tunings that are unsafe or have not converged are excluded. Several at one length and tension
    are repeats.

    Args:
        tunings: In any order.
        forms: Form of single gains by name, such as {"I": "linear"} or "log + tension"; those of
            the others are selected by cross-validation.
        signals: What the rigs measure and command.

    Raises:
        InvalidInput: fewer than two lengths or three tunings remain, there is no such gain or
            form, or its coefficients are not identifiable.
    """
    usable, excluded = _split(tunings)
    given = {name: parse_form(form) for name, form in (forms or {}).items()}
    for name in given:
        if name not in GAIN_NAMES:
            raise InvalidInput(f"there is no gain {name!r}; the gains are {', '.join(GAIN_NAMES)}")
    columns = tuned_columns(usable)
    length_m, tension_N = columns.length_m, columns.tension_N
    lengths = np.unique(length_m)
    if lengths.size < 2 or len(usable) < 3:
        raise InvalidInput(_too_few(len(usable), lengths, excluded))
    labels = usable.map(attrgetter("label"))
    fits = {
        name: fit_gain(name, n, columns, labels, given.get(name))
        for n, name in enumerate(GAIN_NAMES)
    }
    return GainLaw(
        fits=fits,
        tunings=usable,
        excluded=excluded,
        length_m=(float(length_m.min()), float(length_m.max())),
        tension_N=(float(tension_N.min()), float(tension_N.max())),
        signals=signals,
    )


def _split(
    tunings: Sequence[TunedGains],
) -> tuple[LazySequence[TunedGains], tuple[tuple[str, str], ...]]:
    """The usable tunings, and label and reason of the excluded ones."""
    used = LazySequence(range(len(tunings)), tunings.__getitem__)
    excluded = tuple(
        (t.label, "unsafe" if not t.safe else "not converged")
        for t in tunings
        if not (t.safe and t.converged)
    )
    return used.where(lambda t: t.safe and t.converged), excluded


def _too_few(number: int, lengths: FloatArray, excluded: Sequence[tuple[str, str]]) -> str:
    places = ", ".join(f"{length:g} m" for length in lengths) or "no length"
    counts = Counter(reason for _, reason in excluded)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.items())
    return (
        f"{number} tunings at {places} are too few for a law over length; tune at three "
        "lengths or more" + (f"; left out: {reasons}" if reasons else "")
    )


def _within(values: FloatArray, limits: tuple[float, float]) -> BoolArray:
    return np.asarray((limits[0] <= values) & (values <= limits[1]))


def _is_rejected(fit: GainFit) -> bool:
    return fit.lack_of_fit is not None and fit.lack_of_fit.p_value < _LACK_OF_FIT_P


def _over_length(fit: GainFit, unit: str) -> str:
    name, slope = _NAMES.get(fit.name, fit.name), fit.slope
    interval = f"±{slope.half_width:.2g}"
    if np.ptp(fit.points.gain) == 0.0:
        return f"{name} is {fit.mean:.4g}{unit} throughout"
    if fit.form.over_length == "constant":
        verb = "is constant within its error at"
        if _is_rejected(fit):
            verb = "differs between lengths without a trend, about"
        elif slope.is_significant:
            verb = "changes little at"
        return f"{name} {verb} {fit.mean:.3g}{unit} ({slope.value:+.2g} {interval} per metre)"
    verb = "falls" if slope.value < 0.0 else "rises"
    best = "" if fit.form.over_length == "linear" else f", best as {fit.curve}"
    return f"{name} {verb} by {abs(slope.value):.3g} {interval}{unit} per metre{best}"


def _over_tension(law: GainLaw) -> str:
    """Dependence of all gains on the tension, or what else is measured."""
    tension = law.signals.measurement_name
    fits = law.fits.values()
    effects = [(fit, fit.tension_effect) for fit in fits if fit.tension_effect is not None]
    if not effects:
        return f"{tension} was not varied"
    changes = [
        f"{_NAMES.get(fit.name, fit.name)} by {effect.value:+.2g} ±{effect.half_width:.1g}"
        f"{_unit(law, fit)}"
        for fit, effect in effects
        if fit.form.with_tension
    ]
    if not changes:
        return f"{tension} has no detectable effect"
    return (
        f"each {law.signals.measurement_unit or 'unit'} of {tension} changes {', '.join(changes)}"
    )


def _unit(law: GainLaw, fit: GainFit) -> str:
    unit = law.signals.gain_units[fit.name]
    return f" {unit}" if unit and unit != GAIN_UNITS["P"] else ""
