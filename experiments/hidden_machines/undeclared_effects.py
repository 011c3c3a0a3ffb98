"""Effects without a name in reports, and how large they are drawn."""

from experiments.hidden_machines.bases import Base
from experiments.hidden_machines.effects import Draw, Hidden, Rng, force, log_uniform


def quadratic_drag(rng: Rng, base: Base) -> Hidden:
    fast = {"reel": 0.06, "unloaded": 0.3, "stage": 0.25}[base.kind]
    return Hidden("quadratic_drag", {"drag2": force(base) * rng.uniform(0.1, 0.5) / fast**2})


def motor_heating(rng: Rng, base: Base) -> Hidden:
    load = (2.0 if base.kind == "reel" else 0.6) * force(base)
    return Hidden(
        "motor_heating", {"heat": rng.uniform(0.06, 0.25) / load**2, "heat_s": rng.uniform(2, 12)}
    )


def sector_rub(rng: Rng, base: Base) -> Hidden:
    """Friction on part of the drum's way only."""
    middle, width = (0.0, 0.02) if base.kind != "reel" else (18.0 / base.stiffness(0.8), 3e-4)
    if base.kind == "stage":
        width = 0.01
    return Hidden(
        "sector_rub",
        {
            "rub_force": force(base) * rng.uniform(0.08, 0.25),
            "rub_at": middle * rng.uniform(0.9, 1.1),
            "rub_width": width * rng.uniform(0.5, 1.0),
        },
    )


def cable_hysteresis(rng: Rng, base: Base) -> Hidden:
    """A parallel strand that slips: a loop between angle and tension, as high at any tension."""
    return Hidden(
        "cable_hysteresis",
        {
            "loop_force": force(base) * rng.uniform(0.05, 0.15),
            "loop_length": rng.uniform(2.0, 6.0) / base.stiffness(0.8),
        },
    )


def gauge_hysteresis(rng: Rng, base: Base) -> Hidden:
    return Hidden(
        "gauge_hysteresis",
        {
            "gauge_loop": force(base) * rng.uniform(0.04, 0.12),
            "gauge_loop_width": rng.uniform(2.0, 6.0),
        },
    )


def sensitivity_drift(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a ratio
    return Hidden(
        "sensitivity_drift",
        instrument={
            "warming": float(rng.choice([-1, 1]) * rng.uniform(0.03, 0.1)),
            "warming_s": rng.uniform(0.8, 4.0),
        },
    )


def current_crosstalk(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a ratio
    return Hidden(
        "current_crosstalk", {"gauge_current": rng.choice([-1, 1]) * log_uniform(rng, 0.03, 0.12)}
    )


def lost_samples(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a share
    return Hidden(
        "lost_samples",
        instrument={"lost": rng.uniform(0.008, 0.025), "lost_run": float(rng.integers(4, 12))},
    )


def nonlinear_lag(rng: Rng, base: Base) -> Hidden:
    return Hidden(
        "nonlinear_lag",
        {"lag_slow": rng.uniform(5e-3, 15e-3), "lag_size": force(base) * rng.uniform(0.2, 0.6)},
    )


def jolts(rng: Rng, base: Base) -> Hidden:
    """Someone knocks against the machine now and then."""
    return Hidden(
        "jolts",
        instrument={
            "jolt": force(base) * rng.uniform(0.3, 1.0),
            "jolts_per_s": rng.uniform(0.3, 1),
        },
    )


def amplifier_deadband(rng: Rng, base: Base) -> Hidden:
    return Hidden("amplifier_deadband", {"dead_band": force(base) * rng.uniform(0.05, 0.2)})


OUTSIDE: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        quadratic_drag,
        motor_heating,
        sector_rub,
        cable_hysteresis,
        gauge_hysteresis,
        sensitivity_drift,
        current_crosstalk,
        lost_samples,
        nonlinear_lag,
        jolts,
        amplifier_deadband,
    )
}
"""Effects without a name in reports."""
