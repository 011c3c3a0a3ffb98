"""Step 7: 95 % confidence intervals of the numbers of the model that is believed."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.interval import Interval
from plants.diagnosis.pipeline.compare import EffectComparison
from plants.diagnosis.search.intervals import FIRST_ZERO
from plants.diagnosis.search.intervals import intervals as fitted_intervals
from plants.diagnosis.search.validation import ModelStage
from plants.diagnosis.torque_balance.balance import BASE
from plants.effects import Cogging, MainsInterference, Quantisation, Role
from plants.effects.plant_scale import PlantScale


@dataclass(frozen=True, slots=True, eq=False)
class StatedIntervals:
    """Values with their intervals, by the names of a predictor's free numbers.

    Attributes:
        base: Of the base model.
        believed: Of the model that is believed, effects in noise and torque included.
    """

    base: Mapping[str, Interval]
    believed: Mapping[str, Interval]


def intervals(compared: EffectComparison) -> StatedIntervals:
    """The intervals of the first and of the last model of a comparison."""
    first, last = compared.stages[0], compared.stages[-1]
    base = fitted_intervals(first.fitter, first.fit, first.fit)
    believed = dict(base)
    together = compared.together
    if together.weight == "balance" and not together.shared:
        believed |= _of_balance(compared)
    elif last is not first:
        believed = dict(fitted_intervals(last.fitter, last.fit, first.fit, along=True))
        believed |= _where_first_reads_zero(believed, last)
        if together.weight == "both" and last.step.ratio > CONSTANTS.above_noise:
            believed |= _of_both(believed, compared.judged.values if compared.judged else {})
    return StatedIntervals(base, believed | _beside_the_fit(compared))


def _of_both(
    believed: Mapping[str, Interval], balance: Mapping[str, Interval]
) -> dict[str, Interval]:
    """Intervals of laws that two judges name, from the least that one allows to the greatest.

    What is left unexplained moves the values of one otherwise than those of the other: gravity of
    a pendulum in one swing is told by the prediction as 4.4 +- 0.1 N m, by the balance as
    4.2 +- 0.6, and is 3.6 by two swings.
    """
    return {
        name: replace(at, low=min(at.low, other.low), high=max(at.high, other.high))
        for name, other in balance.items()
        if (at := believed.get(name)) is not None and at.unit != "rad"
    }


def _of_balance(compared: EffectComparison) -> Mapping[str, Interval]:
    judged = compared.judged
    if judged is None:
        return {}
    inertia, viscous, offset = (judged.base[name] for name in BASE)
    # What a balance does not see, as the angle over which friction builds up, may be anything.
    last = compared.stages[-1]
    unseen = {
        f.name: Interval(last.fit.values[f.name], f.low, f.high, f.unit)
        for f in last.fit.fitted.predictor.free
        if f.owner in last.fit.names
    }
    constant = Interval(-offset.value, -offset.high, -offset.low, "N m")
    return {
        **unseen,
        **judged.values,
        "drum_inertia_kg_m2": replace(inertia, unit="kg m2"),
        "viscous_friction_Nms": Interval(
            max(viscous.value, 0.0), max(viscous.low, 0.0), max(viscous.high, 0.0), "N m s/rad"
        ),
        "torque_offset_Nm": constant,
    }


def _where_first_reads_zero(
    believed: Mapping[str, Interval], last: ModelStage
) -> dict[str, Interval]:
    """Phases of waves along a drive where the encoder of the first record reads zero.

    Each record has a zero of its own, with which the phase of all may be shifted: sin(N (theta -
    z_n) + phi) has the phase phi - N z_0 there. A reel's waves count from where it is taut.
    """
    zero = last.fit.values.get(FIRST_ZERO)
    if zero is None or PlantScale.of(last.fitter.model.model).has_cable:
        return {}
    shifted = {}
    for effect in last.fit.effects:
        orders = [f"{effect.name}.{name}" for name in effect.named(Role.PERIODS)]
        periods = [believed[order].value for order in orders]
        for name in effect.named(Role.PHASE):
            at = believed[f"{effect.name}.{name}"]
            turned = at.value - (periods or [1.0])[0] * zero
            value = math.remainder(turned, 2.0 * math.pi)
            unlike = [0.5 * abs(zero) * (believed[n].high - believed[n].low) for n in orders]
            half = math.hypot(0.5 * (at.high - at.low), *unlike)
            shifted[f"{effect.name}.{name}"] = replace(
                at, value=value, low=value - half, high=value + half
            )
    return shifted


def _beside_the_fit(compared: EffectComparison) -> dict[str, Interval]:
    read = abs(compared.fitter.model.reading_unit)  # a phase has the sign, of each record its own
    values_of: dict[str, dict[str, Interval]] = {}
    if compared.line is not None:
        values_of[MainsInterference.name] = {
            "amplitude_N": compared.line.amplitude_N.over(read),
            "frequency_Hz": compared.line.frequency_Hz,
            "phase_rad": compared.line.phase_rad,
        }
    q = compared.fitted.noise.coarse_step_N
    if Quantisation in compared.effects and q is not None:
        # Readings are written with few digits, of which the step has as many.
        step = Interval(q, q * (1.0 - 2e-3), q * (1.0 + 2e-3), "N")
        values_of[Quantisation.name] = {"step_N": step.over(read)}
    if compared.waves is not None:
        values_of[Cogging.name] = compared.waves.parameters
    return {
        f"{slug}.{name}": at for slug, values in values_of.items() for name, at in values.items()
    }
