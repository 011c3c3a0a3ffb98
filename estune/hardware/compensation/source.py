"""C text of the compensations, with a rig's numbers; beside that of the controller."""

from pathlib import Path

from estune.hardware.compensation.plan import CompensationPlan
from estune.hardware.scales import CurrentScale

_PROGRAM = Path(__file__).with_name("estune_compensation.c")


def compensation_source(
    plan: CompensationPlan, current: CurrentScale, newtons_per_ampere: float
) -> str:
    """One C file: the numbers of a rig's file, then the functions.

    Args:
        plan: The compensations.
        current: C1.
        newtons_per_ampere: Tension at rest per motor current, N/A.
    """
    windows, forward, gravity = plan.windows, plan.feed_forward, plan.gravity
    numbers: dict[str, float | int | str] = {
        "HISTORY": max(windows.velocity_intervals, windows.acceleration_intervals) + 1,
        "VELOCITY_INTERVALS": windows.velocity_intervals,
        "ACCELERATION_INTERVALS": windows.acceleration_intervals,
        "HALF_BAND": windows.half_band_rad,
        "WEAK": windows.weak,
        "STRONG": windows.strong,
        "COULOMB": forward.friction.coulomb_Nm,
        "STATIC": forward.friction.static_Nm,
        "STRIBECK": forward.friction.stribeck_rad_s,
        "FRACTION": forward.fraction,
        "INERTIA": forward.inertia_kgm2,
        "FEED_FORWARD_MAX": plan.feed_forward_max_N,
        "DRUM_RADIUS": plan.drum_radius_m,
        "WEIGHT": gravity.weight_N_m if gravity else 0.0,
        "RISE": gravity.rise_m if gravity else 0.0,
        "LENGTH": gravity.length_m if gravity else 1.0,
        "LENGTH_MIN": gravity.length_min_m if gravity else 1.0,
        "LENGTH_MAX": gravity.length_max_m if gravity else 1.0,
        "NEWTONS_PER_AMPERE": newtons_per_ampere,
        "CURRENT_CURVE": ", ".join(map(repr, current.coefficients)),
        "CURRENT_MIDDLE": current.middle,
        "CURRENT_HALF": current.half,
        "CURRENT_REACH": current.scaled_max,
    }
    lines = (f"#define ESTUNE_{name} {value}" for name, value in numbers.items())
    return "\n".join(lines) + "\n" + _PROGRAM.read_text(encoding="utf-8")
