"""C text of compensations and hybrid control, with a rig's numbers; beside the controller's."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from estune.core.gains import Gains
from estune.hardware.compensation.plan import CompensationPlan, EyeletFeedForward, Notch, Wave
from estune.hardware.scales import CurrentScale
from estune.reel.hybrid import SwitchingRules

_NO_WAVE = Wave(0.0, 0.0, 0.0, 0.0)
_NO_NOTCH = Notch(1.0, 0.0, 0.0, 0.0, 0.0)
"""What stands in arrays of the C text, which cannot be empty."""


def compensation_source(
    plan: CompensationPlan, current: CurrentScale, newtons_per_ampere: float
) -> str:
    """One C file: the numbers of a rig's file, then the functions."""
    windows, friction, gravity = plan.windows, plan.friction, plan.gravity
    dry = friction.friction if friction else None
    mapped = plan.angle_map
    notches = plan.notches or (_NO_NOTCH,)
    eyelet = plan.eyelet or EyeletFeedForward(0.0, 1.0)
    numbers: dict[str, float | int | str] = {
        "HISTORY": max(windows.velocity_intervals, windows.acceleration_intervals) + 1,
        "VELOCITY_INTERVALS": windows.velocity_intervals,
        "ACCELERATION_INTERVALS": windows.acceleration_intervals,
        "HALF_BAND": windows.half_band_rad,
        "WEAK": windows.weak,
        "STRONG": windows.strong,
        "PERIOD": plan.period_s,
        "COULOMB": dry.coulomb_Nm if dry else 0.0,
        "STATIC": dry.static_Nm if dry else 0.0,
        "STRIBECK": dry.stribeck_rad_s if dry else 1.0,
        "LOAD_SHARE": friction.load_share if friction else 0.0,
        "FRACTION": friction.fraction if friction else 0.0,
        "MEMORY": friction.memory_rad if friction else 1.0,
        "SPREAD": friction.spread if friction else 1.0,
        "TENSION_PER_RAD": plan.tension_per_rad_N,
        "INERTIA": plan.inertia_kgm2,
        "KNOWN_INERTIA": plan.known_inertia_kgm2,
        "KNOWN_VISCOUS": plan.known_viscous_Nms_rad,
        "FEED_FORWARD_MAX": plan.feed_forward_max_N,
        "DRUM_RADIUS": plan.drum_radius_m,
        "WEIGHT": gravity.weight_N_m if gravity else 0.0,
        "RISE": gravity.rise_m if gravity else 0.0,
        "LENGTH": gravity.length_m if gravity else 1.0,
        "LENGTH_MIN": gravity.length_min_m if gravity else 1.0,
        "LENGTH_MAX": gravity.length_max_m if gravity else 1.0,
        "WAVES": _rows(mapped.waves if mapped else (_NO_WAVE,)),
        "MAP_ZERO": mapped.zero_rad if mapped else 0.0,
        "MAP_LEAD": mapped.lead_s if mapped else 0.0,
        "NOTCHES": len(notches),
        "NOTCH_COEFFICIENTS": _rows(notches),
        "EYELET_EXPONENT": eyelet.exponent,
        "EYELET_MEMORY": eyelet.memory_rad,
        "EFFORT_LIMIT": plan.effort_limit_N,
        "NEWTONS_PER_AMPERE": newtons_per_ampere,
        "CURRENT_CURVE": ", ".join(map(repr, current.coefficients)),
        "CURRENT_MIDDLE": current.middle,
        "CURRENT_HALF": current.half,
        "CURRENT_REACH": current.scaled_max,
    }
    return _with_numbers(numbers, "estune_compensation.c")


def hybrid_source(rules: SwitchingRules, position: Gains) -> str:
    """One C file: the numbers of a rig's file, then the functions."""
    numbers: dict[str, float | int | str] = {
        "TENSION_LEAST": rules.tension_min_N,
        "TENSION_MARGIN": rules.margin_N,
        "POSITION_GAINS": ", ".join(map(repr, position.as_tuple())),
    }
    return _with_numbers(numbers, "estune_hybrid.c")


def _rows(rows: Iterable[tuple[float, ...]]) -> str:
    return ", ".join(f"{{{', '.join(map(repr, row))}}}" for row in rows)


def _with_numbers(numbers: Mapping[str, float | int | str], file: str) -> str:
    lines = (f"#define ESTUNE_{name} {value}" for name, value in numbers.items())
    text = Path(__file__).with_name(file).read_text(encoding="utf-8")
    return "\n".join(lines) + "\n" + text
