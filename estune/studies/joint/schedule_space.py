"""The search space of a gain schedule: every gain constant, or straight between two lengths.

A straight gain a + b L, as the paper's I in Fig. 14, is given by its values at the two ends of the
range of lengths, which are both above zero and so have logarithms:

    g(L) = ((L_long - L) g_short + (L - L_short) g_long)/(L_long - L_short)

With those as parameters a schedule is positive everywhere between, and every tuner can step in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

from estune.core.gains import GAIN_NAMES, Gains
from estune.core.schedule import GainCurve, GainSchedule
from estune.errors import InvalidInput
from estune.tuners.search_space import Directions, Point, SearchSpace

AT_SHORT, AT_LONG = "_short", "_long"


@dataclass(frozen=True, slots=True)
class ScheduleSpace(SearchSpace):
    """The parameters of a schedule; made by `over`.

    Attributes:
        length_m: Least and greatest length L_short and L_long, m.

    Raises:
        InvalidInput: the lengths are not in order, or a gain is named neither once nor at both
            ends, or as for a `SearchSpace`.
    """

    length_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def over(
        cls,
        gains: Gains,
        length_m: tuple[float, float],
        straight: Sequence[str] = ("I",),
        factor: float = 100.0,
    ) -> Self:
        """The schedules around gains that are the same at every length.

        Args:
            gains: Where the search begins; all above zero.
            length_m: Least and greatest length, m.
            straight: Gains that may change with length; the others are constant.
            factor: How far each value may go from where it begins, above one.
        """
        for name in straight:
            if name not in GAIN_NAMES:
                raise InvalidInput(
                    f"there is no gain {name!r}; the gains are {', '.join(GAIN_NAMES)}"
                )
        found = dict(zip(GAIN_NAMES, gains.as_tuple(), strict=True))
        values = {
            f"{name}{end}": value
            for name, value in found.items()
            for end in ((AT_SHORT, AT_LONG) if name in straight else ("",))
        }
        return cls(
            names=tuple(values),
            start=tuple(values.values()),
            low=tuple(value / factor for value in values.values()),
            high=tuple(value * factor for value in values.values()),
            length_m=length_m,
        )

    @property
    def directions(self) -> tuple[Directions, ...]:
        """Where each parameter leads at the least length, and where at the greatest."""
        return tuple(
            tuple(
                tuple(float(name in (gain, gain + end)) for gain in GAIN_NAMES)
                for name in self.names
            )
            for end in (AT_SHORT, AT_LONG)
        )

    def ends(self, point: Point) -> tuple[Gains, Gains]:
        """The gains at the least and at the greatest length."""
        values = dict(zip(self.names, point, strict=True))
        short, long = (
            Gains(*[values.get(name, values.get(f"{name}{end}", 0.0)) for name in GAIN_NAMES])
            for end in (AT_SHORT, AT_LONG)
        )
        return short, long

    def gains_at(self, point: Point, length_m: float) -> Gains:
        """The gains of a schedule at a length, m; at the nearest end where beyond the range."""
        low, high = self.length_m
        share = (min(max(length_m, low), high) - low) / (high - low)
        pairs = zip(*(gains.as_tuple() for gains in self.ends(point)), strict=True)
        return Gains(*[(1.0 - share) * short + share * long for short, long in pairs])

    def gains(self, point: Point) -> Gains:
        """The gains of a schedule in the middle of the range."""
        return self.gains_at(point, sum(self.length_m) / 2.0)

    def schedule(self, point: Point, tension_N: float) -> GainSchedule:
        """A point as a gain schedule, valid over the range and at one tension, N."""
        low, high = self.length_m
        short, long = self.ends(point)
        curves = {}
        for name in GAIN_NAMES:
            at_low, at_high = getattr(short, name), getattr(long, name)
            form: Literal["constant", "linear"] = "constant" if name in self.names else "linear"
            slope = 0.0 if form == "constant" else (at_high - at_low) / (high - low)
            curves[name] = GainCurve(form, at_low - slope * low, slope)
        return GainSchedule(**curves, length_m=self.length_m, tension_N=(tension_N, tension_N))

    def _check_names(self) -> None:
        low, high = self.length_m
        if not 0.0 < low < high:
            raise InvalidInput(
                f"a schedule from {low:g} to {high:g} m: give two lengths above zero, the least "
                "first"
            )
        known = {f"{name}{end}" for name in GAIN_NAMES for end in ("", AT_SHORT, AT_LONG)}
        for name in self.names:
            if name not in known:
                raise InvalidInput(
                    f"a schedule has no {name!r}; it has {', '.join(sorted(known))}"
                )
        for name in GAIN_NAMES:
            told = {
                n for n in self.names if n.removesuffix(AT_SHORT).removesuffix(AT_LONG) == name
            }
            if told not in ({name}, {name + AT_SHORT, name + AT_LONG}):
                raise InvalidInput(
                    f"{name} of a schedule is given as {sorted(told)}; give it once or at each end"
                )
