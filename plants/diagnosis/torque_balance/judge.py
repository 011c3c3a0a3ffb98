"""What the torque balance names: laws that each take half of what is left off data left out."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.interval import Interval
from plants.diagnosis.torque_balance.balance import BASE, INERTIA, TorqueBalance
from plants.diagnosis.torque_balance.laws import CHANGING, TorqueLaw, curves, laws
from plants.diagnosis.torque_balance.left_out import BalanceFits, LeftOut, rest_Nm
from plants.effects import Effect


class TorqueJudgement(NamedTuple):
    """What the balance of torques says.

    Attributes:
        laws: The laws it names, the one that explains the most first.
        declared: The laws of the model's own effects.
        values: Their values, and those of declared laws, by slug and parameter.
        base: Inertia, viscous friction and constant torque beside them, by term.
        rivals: Titles of laws that explain data left out as well as the last of them.
        like: The curve without a name that leaves less than half of what they do, or empty.
        torque_Nm: Torque of the motor, rms.
        before_Nm: What inertia, viscous friction, a constant and declared laws leave of it on data
            left out.
        noise_Nm: What may be left by a complete model.
        stretches: Number of stretches of time that were left out in turn.
        held_Nm: The two above on records held out of all fits, or None.
        changes_Nm: The least and the greatest dry friction in the course of a record, where one of
            constant size is not what there is; or None.
    """

    laws: tuple[TorqueLaw, ...]
    declared: tuple[TorqueLaw, ...]
    values: dict[str, Interval]
    base: dict[str, Interval]
    rivals: tuple[str, ...]
    like: str
    torque_Nm: float
    before_Nm: float
    after_Nm: float
    noise_Nm: float
    stretches: int
    held_Nm: tuple[float, float] | None = None
    changes_Nm: tuple[float, float] | None = None

    @property
    def effects(self) -> tuple[type[Effect], ...]:
        """The effects named."""
        return tuple(law.effect for law in self.laws if law.effect is not None)

    @property
    def is_complete(self) -> bool:
        """Whether what is left is no more than a complete model may leave."""
        return not self.like and self.after_Nm <= CONSTANTS.above_noise * self.noise_Nm

    def disputes(self, limited: TorqueBalance, whole: TorqueBalance, *, beside: bool) -> bool:
        """Whether a limit leaves twice as much of a balance, or beside another effect no less."""
        own = (*self.declared, *self.laws)
        left, kept = (BalanceFits(balance).left_out(own) for balance in (limited, whole))
        return (
            not _is_better(left, kept) if beside else CONSTANTS.law_left * left.total > kept.total
        )

    def denies(
        self, balance: TorqueBalance, effect: type[Effect], predicted: Mapping[str, float]
    ) -> bool:
        """Whether a balance could see an effect of the size predicted, and shows none."""
        fits, own = BalanceFits(balance), (*self.declared, *self.laws)
        tried = [(fits.left_out((*own, law)), law) for law in laws(balance, (effect,))]
        if not tried:
            return False
        beside, law = min(tried, key=lambda one: one[0].total)
        if _is_better(beside, fits.left_out(own)):
            return False
        (size, *_) = law.values(beside.sizes)
        key = f"{effect.name}.{size}"
        at = _values(beside, beside, law)[key]
        return abs(predicted[key]) > max(abs(at.low), abs(at.high))

    @property
    def families(self) -> frozenset[str]:
        """Their families."""
        return frozenset(law.family for law in self.laws)


def judge(
    balance: TorqueBalance,
    effects: Sequence[type[Effect]],
    declared: Sequence[type[Effect]],
    narrower: TorqueBalance | None = None,
    aside: TorqueBalance | None = None,
) -> TorqueJudgement:
    """The laws that a balance shows.

    Args:
        effects: Effects to choose from; those that are no law of a torque are not looked at.
        declared: Effects that the model has, which are part of what laws are compared with.
        narrower: The same with a narrower kernel: what no law explains shifts values by about as
            much as the kernel does.
        aside: That of records held out, with the kernel and the sizes of the first.
    """
    fits = BalanceFits(balance)
    own = _declared(fits, declared)
    known = {law.family for law in own}
    listed = [law for law in laws(balance, effects) if law.family not in known]
    base = kept = fits.left_out(own)
    sets = _possible_sets(fits, own, listed)
    floor = balance.torque_Nm.size * balance.noise_Nm**2
    for n in range(1, CONSTANTS.laws_most + 1):
        best = min((f for f in sets if _added(f, own) == n), key=_total, default=None)
        more = n - _added(kept, own)
        if (
            best is not None
            and kept.total > floor
            and best.total <= CONSTANTS.law_left**more * kept.total
        ):
            kept = _simplest(best, sets)
    like, vetoed = _like(fits, kept)
    changes_Nm = _changes_Nm(fits, kept, sets) if balance.both_ways else None
    vetoed = vetoed or changes_Nm is not None
    rivals = () if vetoed or kept is base else _rivals(kept, sets)
    if vetoed:
        kept = base
    other = kept if narrower is None else BalanceFits(narrower).left_out(kept.laws)
    samples, power = balance.torque_Nm.size, float(np.square(balance.torque_Nm).sum())
    return TorqueJudgement(
        _by_strength(fits, kept, len(own)),
        own,
        {name: at for law in kept.laws for name, at in _values(kept, other, law).items()},
        {name: _interval(kept, other, name) for name in BASE},
        rivals,
        like,
        torque_Nm=math.sqrt(power / samples),
        before_Nm=math.sqrt(base.total / samples),
        after_Nm=math.sqrt(kept.total / samples),
        noise_Nm=balance.noise_Nm,
        stretches=len(base.error),
        held_Nm=None if aside is None else (rest_Nm(aside, base), rest_Nm(aside, kept)),
        changes_Nm=changes_Nm,
    )


def _total(fit: LeftOut) -> float:
    return fit.total


def _added(fit: LeftOut, own: Sequence[TorqueLaw]) -> int:
    """Number of laws beside the declared ones."""
    return len(fit.laws) - len(own)


def _declared(fits: BalanceFits, declared: Sequence[type[Effect]]) -> tuple[TorqueLaw, ...]:
    """The laws of the model's own effects, each in the form that fits best."""
    own: tuple[TorqueLaw, ...] = ()
    for effect in dict.fromkeys(declared):
        tried = [fits.left_out((*own, law)) for law in laws(fits.balance, (effect,))]
        if tried:
            own = min(tried, key=_total).laws
    return own


def _possible_sets(
    fits: BalanceFits, own: tuple[TorqueLaw, ...], listed: Sequence[TorqueLaw]
) -> list[LeftOut]:
    """Fits of all sets of a few laws of different families, of sizes that a drive can have."""
    sets = []
    for n in range(1, CONSTANTS.laws_most + 1):
        for chosen in itertools.combinations(listed, n):
            if len({law.family for law in chosen}) == n:
                fit = fits.left_out((*own, *chosen))
                if _possible(fit):
                    sets.append(fit)
    return sets


def _possible(fit: LeftOut) -> bool:
    """Whether frictions are above zero, and an inertia is not surely below."""
    if any(fit.sizes[name] <= 0.0 for law in fit.laws for name in law.positive):
        return False
    return fit.sizes[INERTIA] + CONSTANTS.law_sure * fit.deviations[INERTIA] > 0.0


def _simplest(best: LeftOut, sets: Sequence[LeftOut]) -> LeftOut:
    """The set, or the one of the same families with fewer terms that it does not halve."""

    def terms(fit: LeftOut) -> int:
        return sum(len(law.columns) for law in fit.laws)

    def families(fit: LeftOut) -> list[str]:
        return sorted(law.family for law in fit.laws)

    alike = [f for f in sets if families(f) == families(best)]
    simpler = [
        f for f in alike if terms(f) < terms(best) and best.total > CONSTANTS.law_left * f.total
    ]
    return min(simpler, key=lambda f: (terms(f), f.total), default=best)


def _is_better(fit: LeftOut, other: LeftOut) -> bool:
    """Whether a fit leaves less of the stretches left out than another, beyond chance."""
    gain = other.error - fit.error
    spread = float(gain.std(ddof=1)) / math.sqrt(gain.size)
    return float(gain.mean()) > CONSTANTS.law_sure * spread


def _rivals(kept: LeftOut, sets: Sequence[LeftOut]) -> tuple[str, ...]:
    """Titles of laws in sets of as many that explain as much, but for chance."""
    families = {law.family for law in kept.laws}
    titles = dict[str, None]()
    for other in sets:
        unlike = [law for law in other.laws if law.family not in families]
        as_many = len(other.laws) == len(kept.laws) and unlike
        if (
            as_many
            and kept.total > CONSTANTS.law_left * other.total
            and not _is_better(kept, other)
        ):
            titles |= dict.fromkeys(law.title for law in unlike)
    return tuple(titles)


def _like(fits: BalanceFits, kept: LeftOut) -> tuple[str, bool]:
    """The curve without a name that leaves less than half, and whether it leaves next to nothing.

    It stands in for the laws of its own variable. On data left out its freedom costs it more than
    a law's does.
    """
    tried = []
    for curve in curves():
        beside = tuple(law for law in kept.laws if law.variable != curve.variable)
        fit = fits.left_out((*beside, curve))
        if fit.total <= CONSTANTS.law_left * kept.total and _is_better(fit, kept):
            tried.append((fit.total, curve.title))
    if not tried:
        return "", False
    total, title = min(tried)
    return title, total <= (1.0 - CONSTANTS.named_share) * kept.total


def _changes_Nm(
    fits: BalanceFits, kept: LeftOut, sets: Sequence[LeftOut]
) -> tuple[float, float] | None:
    """Least and greatest dry friction over time, where one halves and leaves half of the rest."""
    others = [law for law in kept.laws if law.family != CHANGING.family]
    of_constant = [f for f in sets if {law.family for law in f.laws} == {CHANGING.family}]
    best = min((kept, *of_constant), key=_total)
    fit = fits.left_out((*others, CHANGING))
    sizes = [fit.sizes[name] for name in CHANGING.columns]
    halves = max(min(sizes), 0.0) <= CONSTANTS.law_left * max(sizes)
    shown = fit.total <= CONSTANTS.law_left * best.total and _is_better(fit, best)
    return (min(sizes), max(sizes)) if halves and shown else None


def _by_strength(fits: BalanceFits, kept: LeftOut, own: int) -> tuple[TorqueLaw, ...]:
    """The laws added, first the one whose absence leaves the most."""

    def without(law: TorqueLaw) -> float:
        return fits.left_out([one for one in kept.laws if one is not law]).total

    return tuple(sorted(kept.laws[own:], key=without, reverse=True))


def _values(kept: LeftOut, other: LeftOut, law: TorqueLaw) -> dict[str, Interval]:
    """Values of a law's effect; each size moved by its error moves them."""
    assert law.effect is not None  # noqa: S101  curves are never kept
    declared = law.effect.parameters()
    at, beside = law.values(kept.sizes), law.values(other.sizes)
    shifted = [
        law.values(dict(zip(kept.names, row, strict=True))) for row in kept.shifted.tolist()
    ]
    n = len(shifted)
    values = {}
    for name, value in at.items():
        away = np.array([one[name] - value for one in (*shifted, beside)])
        if declared[name].is_phase:
            away = np.remainder(away + math.pi, 2.0 * math.pi) - math.pi
        deviation = math.sqrt((n - 1.0) / n * float(np.square(away[:-1]).sum()))
        half = _half(n, deviation, float(away[-1]))
        low = max(value - half, declared[name].low)
        values[f"{law.effect.name}.{name}"] = Interval(
            value, low, min(value + half, declared[name].high), declared[name].unit
        )
    return values


def _interval(kept: LeftOut, other: LeftOut, name: str) -> Interval:
    away = other.sizes[name] - kept.sizes[name]
    half = _half(len(kept.shifted), kept.deviations[name], away)
    return Interval(kept.sizes[name], kept.sizes[name] - half, kept.sizes[name] + half, "")


def _half(stretches: int, deviation: float, away: float) -> float:
    """Half a 95 % interval from a standard error of so many stretches (Student's t).

    Args:
        stretches: Their number.
        deviation: The standard error.
        away: How far a narrower kernel moves the value.
    """
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    return math.hypot(float(stdtrit(stretches - 1.0, 0.975)) * deviation, away)
