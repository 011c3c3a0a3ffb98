"""The remedies of a diagnosis, each with what it is predicted to bring.

The prediction runs the fitted model with and without the remedy at the same gains. A remedy keeps
the numbers of the diagnosis; the machine has those of a draw from their intervals, and each draw
other noise. What the model leaves unexplained of the error that the effect explains may change the
ratio by as large a part of its distance from one, and so may a friction that is not quite the
machine's. So the interval of a ratio is what the uncertainty of the diagnosis makes of it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, Protocol

import casadi as ca
import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import EstuneError, InvalidInput
from estune.trial.tracking import WIDE
from plants.effects import Effect, Port, Site
from plants.effects.parameter import Role
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import SAFE_FRACTION, Place, Remedy
from plants.remedies.behaviour import MEASURES, behaviour, sensitivity
from plants.remedies.calibration import OFFSET_NOISES, has_moved
from plants.simulation.compensation import TrialCompensation, compensation_of

DRAWS = 16
"""Machines drawn from the intervals: their 2.5 and 97.5 % points are then the outermost two."""
WORTH = 0.02
"""Least predicted gain of tracking, reversal or cost that is worth the work."""
TOO_WIDE = 0.3
"""Half an interval relative to the value above which a number is too uncertain to be fed forward:
at 1.3 of the friction and 0.8 of it fed forward, a tenth too much is fed at the other end."""
REVERSAL_MARGIN = 0.1
"""What reversals are predicted too well by on machines whose friction is not the model's: 0.10 on
average over 20 of `experiments.hidden_machines`. The upper end of their interval has it."""
FORM, REPEATED = 0.07, 0.015
"""Part of what a friction fed forward changes by which its law is not the machine's, and what a
ratio at rest repeats to: of 19 such machines (seeds 50200 to 50233) tracking and cost are off by 7
and 5 % of their change in the median, rest by at most 0.013 beside a change of none. Without both
13, 14 and 12 are inside the intervals, with both 19, 19 and 19."""


class FittedNumber(Protocol):
    """A fitted value and its interval."""

    value: float
    low: float
    high: float


class Found(Protocol):
    """An effect of a diagnosis, with its fitted parameters."""

    name: str
    parameters: Mapping[str, Any]
    effect: Effect


@dataclass(frozen=True, slots=True)
class PredictedRatio:
    """A predicted ratio of with to without, and its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Offer:
    """One row of what can be done.

    Attributes:
        effect: Slug of the effect; empty for a calibration of the base model.
        place: Where it is applied; see `plants.effects.remedy.Place`.
        worth: Whether it is predicted to gain enough; None where nothing is predicted.
        ratios: Predicted ratios by `MEASURES`, and of Ms (`sensitivity`) where it takes margin.
        tables: Tables of `[compensation]` that switch it on.
        refused: Why it cannot be done yet, with the experiment that helps; empty where it can.
        gains: Gains that the prediction is for; None where nothing is predicted.
    """

    effect: str
    place: Place
    title: str
    work: str
    harm: str = ""
    worth: bool | None = None
    ratios: Mapping[str, PredictedRatio] = field(default_factory=dict)
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    refused: str = ""
    gains: Gains | None = None


def offers_for(diagnosis: Any, gains: Gains | None = None) -> tuple[Offer, ...]:
    """What can be done about the effects of a diagnosis, the greatest gain first.

    Args:
        diagnosis: A finished diagnosis, `plants.diagnosis.result.DiagnosisResult`.
        gains: Gains of the loop; by default those of the records, or else the model's own safe
            ones.
    """
    gains = gains or getattr(diagnosis, "gains", None)
    moved = _calibrations(diagnosis)
    if moved:
        return moved
    offers = [
        _offer(diagnosis, found, remedy, gains)
        for found in diagnosis.effects
        for remedy in _remedies(found, diagnosis.augmented)
    ]
    return tuple(sorted(offers, key=_gain, reverse=True))


def _calibrations(diagnosis: Any) -> tuple[Offer, ...]:
    """The calibration, where the fit has moved it: nothing else is offered before."""
    noise = getattr(diagnosis.noise, "channels", {}).get("tension_N")
    for c in diagnosis.calibrations:
        fitted = (c.with_effects if diagnosis.effects else c.base).value
        if has_moved(c.name, c.given, fitted, noise and OFFSET_NOISES * noise.rms):
            title = (
                f"hang weights and calibrate C2 and C1 first: the records move {c.name} from "
                f"{c.given:.4g} to {fitted:.4g} {c.unit}".rstrip()
            )
            harm = "other remedies would rest on a wrong scale; explain anew afterwards"
            work = "recalibrate with four weights"
            return (Offer("", Place.CALIBRATION, title, work, harm),)
    return ()


def _remedies(found: Found, model: Any) -> tuple[Remedy, ...]:
    values = SimpleNamespace(**{name: i.value for name, i in found.parameters.items()})
    return type(found.effect).remedies(values, PlantScale.of(model))


def _offer(diagnosis: Any, found: Found, remedy: Remedy, gains: Gains | None) -> Offer:
    row = Offer(found.name, remedy.place, remedy.title, remedy.effort, remedy.harm)
    bounds: Any = found.parameters.get(remedy.sized_by)
    if bounds is None:
        return row
    if type(found.effect).parameters()[remedy.sized_by].neutral == 1.0:  # a ratio
        bounds = PredictedRatio(1.0 - bounds.value, 1.0 - bounds.high, 1.0 - bounds.low)
    refused = _too_wide(found, remedy, bounds)
    if refused and remedy.place is Place.LOOP:
        return replace(row, refused=refused)
    fraction = safe_fraction(bounds)
    tables = {
        name: dict(table) | ({"fraction": fraction} if "fraction" in table else {})
        for name, table in remedy.tables.items()
    }
    ratios, at = _predicted(diagnosis, found, remedy, tables, gains)
    return replace(
        row,
        worth=_worth(ratios),
        harm="; ".join(filter(None, (remedy.harm, _predicted_harm(ratios)))),
        ratios=ratios,
        tables=tables,
        gains=at,
    )


def _predicted_harm(ratios: Mapping[str, PredictedRatio]) -> str:
    """Measures that are predicted to grow by more than is worth a remedy, in words."""
    worse = [(name, at) for name, at in ratios.items() if at.value > 1.0 + WORTH]
    listed = ", ".join(f"{name} {at.value:.2f} times" for name, at in worse)
    return f"predicted to be worse: {listed}" if worse else ""


def _worth(ratios: Mapping[str, PredictedRatio]) -> bool | None:
    """Whether something gains enough and nothing else loses as much; None where unpredicted."""
    if not ratios:
        return None
    gained = min(ratios[name].value for name in MEASURES if name != "rest") <= 1.0 - WORTH
    harmed = any(ratios[name].value > 1.0 + WORTH for name in MEASURES if name != "rest")
    unsafe = "sensitivity" in ratios and ratios["sensitivity"].high > 1.0 + WORTH
    return gained and not harmed and not unsafe and not ratios["rest"].low > 1.0 + WORTH


def safe_fraction(bounds: FittedNumber) -> float:
    """Share of a number that is fed forward: none of its interval is exceeded, N/A without one."""
    return max(0.0, min(SAFE_FRACTION, bounds.low / bounds.value)) if bounds.value > 0.0 else 0.0


def _too_wide(found: Found, remedy: Remedy, bounds: FittedNumber) -> str:
    half = 0.5 * (bounds.high - bounds.low)
    if not (math.isfinite(half) and bounds.value != 0.0):
        return f"{remedy.sized_by} has no interval; {_experiment(found)}"
    if half <= TOO_WIDE * abs(bounds.value):
        return ""
    return (
        f"{remedy.sized_by} is known to {100.0 * half / abs(bounds.value):.0f} %, more than "
        f"{100.0 * TOO_WIDE:.0f} %; {_experiment(found)}"
    )


def _experiment(found: Found) -> str:
    shown = found.effect.excitation or "more records of it"
    return f"measure {shown}, and explain the records together"


def _predicted(
    diagnosis: Any,
    found: Found,
    remedy: Remedy,
    tables: Mapping[str, Mapping[str, Any]],
    gains: Gains | None,
) -> tuple[dict[str, PredictedRatio], Gains | None]:
    """Ratios of the measures with the remedy to those without, and the gains they are for.

    No ratios where nothing is predicted.
    """
    model = diagnosis.augmented
    if model.profile.loop != "closed" or not (tables or remedy.removes):
        return {}, None
    try:
        beside = compensation_of(tables, PlantScale.of(model), model.controller)
        about = model.describe("model", gains)
        rows = [
            _ratios((model, about), drawn, beside, found, remedy, seed=seed)
            for seed, drawn in enumerate((found.effect, *_draws(found)))
        ]
    except EstuneError:  # a model that cannot be run at these gains predicts nothing
        return {}, None
    if not np.isfinite(rows).all():  # a machine of the intervals does not bear it
        return {}, None
    unexplained = _unexplained(float(getattr(diagnosis, "closure", math.nan)))
    ratios = _intervals(np.array(rows), unexplained, widened="friction" in tables)
    if "mode" in tables:
        ratios["sensitivity"] = _sensitivity(model, about.gains, found, tables)
    return ratios, about.gains


def _unexplained(closure: float) -> float:
    """Part of the error, rms, that is left by what explains a share of its power; 0 if unknown."""
    return math.sqrt(1.0 - min(max(closure, 0.0), 1.0)) if math.isfinite(closure) else 0.0


def _sensitivity(
    model: Any, gains: Gains, found: Found, tables: Mapping[str, Mapping[str, Any]]
) -> PredictedRatio:
    """Ratio of Ms, of the mode found and of the drawn ones of least and greatest frequency.

    At the same gains a notch may lower every measure and take the margin that a tuning would use.
    """
    ordered = sorted(_draws(found), key=lambda one: float(getattr(one, "frequency_Hz", 0.0)))
    machines = [
        with_effect(model, found.effect, e) for e in (found.effect, ordered[0], ordered[-1])
    ]
    value, *others = (sensitivity(m, gains, tables) / sensitivity(m, gains, {}) for m in machines)
    return PredictedRatio(value, min(value, *others), max(value, *others))


def _ratios(
    rig: tuple[Any, Any],
    true: Effect,
    beside: TrialCompensation | None,
    found: Found,
    remedy: Remedy,
    *,
    seed: int,
) -> FloatArray:
    """Measures with the remedy over those without, on a machine that has the drawn effect."""
    model, about = rig
    machine = with_effect(model, found.effect, true)
    mended = machine
    if beside is None:
        told, size = getattr(found.effect, remedy.sized_by), getattr(true, remedy.sized_by)
        allowed = true.parameters()[remedy.sized_by]
        left = size - remedy.removes * told
        left = abs(left) if allowed.low >= 0.0 else left
        neutral = 0.0 if allowed.neutral is None else allowed.neutral
        left = min(max(left, allowed.low), allowed.high) if neutral == 0.0 else neutral
        mended = with_effect(model, found.effect, replace(true, **{remedy.sized_by: left}))
    gains, settling = about.gains, about.settling_time_s
    left_effect = replace(true, **{remedy.sized_by: left}) if beside is None else true
    # Waves over the angle are judged where the drum turns as far as the tension can turn it.
    waves = any(p.role is Role.PERIODS for p in true.parameters().values())
    wide = about.limits if waves or WIDE & set(remedy.tables) else None
    after = behaviour(
        mended, gains, settling, beside, truth=truth_behind(left_effect), limits=wide, seed=seed
    )
    before = behaviour(machine, gains, settling, truth=truth_behind(true), limits=wide, seed=seed)
    return np.asarray(after / before)


def truth_behind(effect: Effect) -> Callable[[FloatArray], FloatArray] | None:
    """The tension that is there where an effect of the gauge reads another; None for others."""
    if effect.port is not Port.GAUGE or effect.states or effect.in_noise:
        return None
    numbers = SimpleNamespace(**vars(effect))

    def tension_N(reading_N: FloatArray) -> FloatArray:
        site = Site(Port.GAUGE, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        _, signal = effect.rest(numbers, ca.DM(0, 1), ca.DM(reading_N), site)
        return np.asarray(signal, dtype=np.float64).ravel()

    return tension_N


def _intervals(
    rows: FloatArray, unexplained: float, *, widened: bool
) -> dict[str, PredictedRatio]:
    """Ratios of the fitted model, and the range of the draws.

    Args:
        rows: Of the fitted model, then of the draws, shape (draws + 1, measures).
        unexplained: Part of the error, rms, that the effect leaves of what there was without it.
        widened: Whether friction is fed forward.
    """
    found = {}
    for name, column in zip(MEASURES, rows.T, strict=True):
        form = FORM if widened else 0.0
        more = (unexplained + form) * abs(float(column[0]) - 1.0)
        more += REPEATED if name == "rest" else 0.0
        low, high = float(column.min()) - more, float(column.max()) + more
        high += REVERSAL_MARGIN if widened and name == "reversal" else 0.0
        found[name] = PredictedRatio(float(column[0]), max(low, 0.0), high)
    return found


def _draws(found: Found) -> list[Effect]:
    random = np.random.default_rng(0)
    drawn = []
    for _ in range(DRAWS):
        values: dict[str, float] = {}
        for name, p in found.effect.parameters().items():
            value, bounds = float(getattr(found.effect, name)), found.parameters.get(name)
            spread = 0.0 if bounds is None else (bounds.high - bounds.low) / 3.92
            # Relative: the effect's own number may be in another unit than the interval.
            scale = value / bounds.value if bounds is not None and bounds.value else 1.0
            step = float(random.standard_normal()) * spread * scale
            step = step if math.isfinite(step) else 0.0
            values[name] = min(max(value + step, p.low), p.high)
        drawn.append(replace(found.effect, **values))
    return drawn


def with_effect(model: Any, old: Effect, new: Effect) -> Any:
    """The model with an effect in the place of another of its kind.

    Raises:
        InvalidInput: the model has no such effect.
    """
    effects = tuple(new if isinstance(one, type(old)) else one for one in model.effects)
    if new not in effects:
        raise InvalidInput(f"the model has no {old.name}")
    return replace(model, effects=effects)


def _gain(offer: Offer) -> float:
    """What a row is sorted by: the greatest predicted gain."""
    gains = [1.0 - offer.ratios[name].value for name in MEASURES[:3] if name in offer.ratios]
    return max(gains, default=-math.inf)
