"""The law of tuned gains over cable length and tension: the paper's adaptive law with its doubts.

The paper regresses the integral gain on the cable length, I = a + b L, and finds it falling
(Fig. 14). `fit_law` does so for each gain, and beside the straight line looks at the forms of
`estune.studies.law.model_selection`.

What is said of a slope is said of the straight line, which is fitted whatever form is chosen: its
interval does not know of the choice, and is not made narrower by it. Bands are those of the chosen
form, given that form.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estune.core.gains import GAIN_NAMES
from estune.core.quantities import FloatArray
from estune.core.schedule import GainSchedule
from estune.errors import InvalidInput
from estune.studies.law import text
from estune.studies.law.gain_fit import LEVEL, GainFit, fit_gain
from estune.studies.law.model_selection import shape_named
from estune.studies.law.robust_regression import student
from estune.studies.law.tuned import TunedGains


class Band(NamedTuple):
    """What the law says of a gain at some lengths; arrays of their shape.

    Attributes:
        gain: The fitted curve.
        low: Lower end of the confidence band of the curve.
        high: Its upper end.
        new_low: Lower end of the prediction band, in which one further tuning would lie.
        new_high: Its upper end.
        extrapolated: True beyond the range that was tuned.
    """

    gain: FloatArray
    low: FloatArray
    high: FloatArray
    new_low: FloatArray
    new_high: FloatArray
    extrapolated: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class GainLaw:
    """The fits of all four gains.

    Attributes:
        fits: By name, in the order of `GAIN_NAMES`.
        tunings: Those they are fitted to.
        excluded: Label and reason of each tuning that was left out.
        length_m: Least and greatest length tuned at, m.
        tension_N: Least and greatest tension tuned at, N.
    """

    fits: Mapping[str, GainFit]
    tunings: tuple[TunedGains, ...]
    excluded: tuple[tuple[str, str], ...]
    length_m: tuple[float, float]
    tension_N: tuple[float, float]

    @property
    def sentence(self) -> str:
        """The law in a plain sentence, with 95 % intervals."""
        return text.sentence(self.fits.values())

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is to be known beside the sentence: what was left out, and where a form misses."""
        return text.remarks(self.fits.values(), self.excluded)

    def band(
        self,
        name: str,
        length_m: ArrayLike,
        tension_N: float | None = None,
        *,
        level: float = LEVEL,
        extrapolate: bool = False,
    ) -> Band:
        """One gain over lengths, with its confidence and prediction bands.

        Args:
            name: The gain, of `GAIN_NAMES`.
            length_m: Cable lengths, m, any shape.
            tension_N: Tension, N; None is the middle of those tuned at.
            level: Of the bands, between 0 and 1.
            extrapolate: Whether lengths and tensions beyond those tuned at are answered, and
                marked so in the band.

        Raises:
            InvalidInput: there is no such gain, the level is not between 0 and 1, or a length or
                tension is beyond those tuned at and `extrapolate` was not given.
        """
        if name not in self.fits:
            raise InvalidInput(f"there is no gain {name!r}; the gains are {', '.join(self.fits)}")
        length = np.asarray(length_m, dtype=np.float64)
        tension = np.full_like(
            length, sum(self.tension_N) / 2.0 if tension_N is None else tension_N
        )
        beyond = self._beyond(length, tension)
        if beyond.any() and not extrapolate:
            raise InvalidInput(
                f"the law holds from {self.length_m[0]:g} to {self.length_m[1]:g} m and "
                f"{self.tension_N[0]:g} to {self.tension_N[1]:g} N; {length[beyond].flat[0]:g} m "
                f"at {tension[beyond].flat[0]:g} N is beyond: tune there too, or say "
                "extrapolate=True"
            )
        of = self.fits[name]
        rows = of.shape.design(length, tension)
        variance = np.einsum("...i,ij,...j", rows, of.fit.covariance, rows)
        new = variance + float(np.median(of.fit.deviations)) ** 2
        t, value = student(level, of.fit.degrees), rows @ of.fit.coefficients
        width, new_width = t * np.sqrt(variance), t * np.sqrt(new)
        return Band(
            value, value - width, value + width, value - new_width, value + new_width, beyond
        )

    def schedule(self) -> GainSchedule:
        """The law as a gain schedule, valid where it was tuned.

        Raises:
            InvalidInput: a form that was asked for falls below zero within the range.
        """
        curves = {name: of.curve for name, of in self.fits.items()}
        return GainSchedule(**curves, length_m=self.length_m, tension_N=self.tension_N)

    def to_json(self) -> dict[str, Any]:
        """The law as JSON values: sentence, schedule, and each fit with its figures."""
        return {
            "sentence": self.sentence,
            "remarks": list(self.remarks),
            "schedule": self.schedule().as_dict(),
            "fits": {name: of.to_json() for name, of in self.fits.items()},
            "excluded": [{"label": label, "reason": why} for label, why in self.excluded],
        }

    def _beyond(self, length: FloatArray, tension: FloatArray) -> NDArray[np.bool_]:
        within = [
            (low <= value) & (value <= high)
            for value, (low, high) in ((length, self.length_m), (tension, self.tension_N))
        ]
        return np.asarray(~(within[0] & within[1]))


def fit_law(tunings: Sequence[TunedGains], *, forms: Mapping[str, str] | None = None) -> GainLaw:
    """Fits the law to tunings at different lengths.

    Tunings that are unsafe or have not converged are left out and named. Several at one length and
    tension are repeats.

    Args:
        tunings: In any order.
        forms: The form of single gains by name, such as {"I": "linear"} or "log + tension"; the
            others are chosen.

    Raises:
        InvalidInput: fewer than two lengths or three tunings are left, or there is no such gain
            or form, or the tunings do not tell its coefficients apart.
    """
    kept, excluded = _sorted_out(tunings)
    asked = {name: shape_named(form) for name, form in (forms or {}).items()}
    for name in asked:
        if name not in GAIN_NAMES:
            raise InvalidInput(f"there is no gain {name!r}; the gains are {', '.join(GAIN_NAMES)}")
    lengths, tensions = [t.length_m for t in kept], [t.tension_N for t in kept]
    fits = {name: fit_gain(name, n, kept, asked.get(name)) for n, name in enumerate(GAIN_NAMES)}
    return GainLaw(
        fits=fits,
        tunings=kept,
        excluded=excluded,
        length_m=(min(lengths), max(lengths)),
        tension_N=(min(tensions), max(tensions)),
    )


def _sorted_out(
    tunings: Sequence[TunedGains],
) -> tuple[tuple[TunedGains, ...], tuple[tuple[str, str], ...]]:
    """The tunings to be fitted to, and those left out with the reason."""
    excluded = tuple(
        (t.label, "unsafe" if not t.safe else "not converged")
        for t in tunings
        if not (t.safe and t.converged)
    )
    kept = tuple(t for t in tunings if t.safe and t.converged)
    lengths = {t.length_m for t in kept}
    if len(lengths) < 2 or len(kept) < 3:
        at = ", ".join(f"{length:g} m" for length in sorted(lengths)) or "no length"
        named = ", ".join(f"{label} ({why})" for label, why in excluded)
        raise InvalidInput(
            f"{len(kept)} tunings at {at} are too few for a law over length; tune at three "
            "lengths or more" + (f"; left out: {named}" if named else "")
        )
    return kept, excluded
