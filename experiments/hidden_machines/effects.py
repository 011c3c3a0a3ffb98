"""The effects that may be hidden: how they act in the machine, and how large they are drawn.

The slugs are those reports use. `truth` holds only numbers that mean the same in any formulation,
under the names and in the units reports use.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from experiments.hidden_machines.bases import Base, CURRENT_LOOP_s

Rng = np.random.Generator


@dataclass(frozen=True)
class Hidden:
    """One effect drawn.

    Attributes:
        name: Its slug.
        machine: What it changes in the machine, in force at the rim, metres and seconds.
        instrument: What it changes around the machine; see `records.recorded`.
        truth: Its parameters, where a report's mean the same.
    """

    name: str
    machine: dict[str, float] = field(default_factory=dict)
    instrument: dict[str, float] = field(default_factory=dict)
    truth: dict[str, float] = field(default_factory=dict)


Draw = Callable[[Rng, Base], Hidden]
SOUND_LAG_s = float(np.mean(CURRENT_LOOP_s))
"""Lag of a sound current loop: the owner's model has none, so that a drive is late by it, too."""


def force(base: Base) -> float:
    """A force that is felt well in this machine, N at the rim."""
    return {"reel": 10.0, "unloaded": 6.0, "stage": 150.0}[base.kind]


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A number whose logarithm is uniform between two bounds."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def half_step_m(base: Base) -> float:
    """Half a step of the encoder, in metres at the rim."""
    return np.pi / base.encoder_counts * base.radius_m


def coulomb_friction(rng: Rng, base: Base) -> Hidden:
    F = force(base) * log_uniform(rng, 0.04, 0.2)
    return Hidden(
        "coulomb_friction",
        {"dry": F, "bristle": half_step_m(base) * rng.uniform(0.4, 1.0)},
        truth={"torque_Nm": F * base.radius_m},
    )


def stribeck_friction(rng: Rng, base: Base) -> Hidden:
    F, more = force(base) * log_uniform(rng, 0.05, 0.2), rng.uniform(0.4, 1.0)
    fast = {"reel": 0.012, "unloaded": 0.03, "stage": 0.01}[base.kind] * log_uniform(rng, 0.6, 1.6)
    return Hidden(
        "stribeck_friction",
        {
            "dry": F,
            "dry_excess": more * F,
            "dry_velocity": fast,
            "bristle": half_step_m(base) * rng.uniform(0.4, 1.0),
        },
        truth={
            "coulomb_Nm": F * base.radius_m,
            "excess_Nm": more * F * base.radius_m,
            "stribeck_rad_s": fast / base.radius_m,
        },
    )


def dahl_hysteresis(rng: Rng, base: Base) -> Hidden:
    """Slip elements in series, or bristles that give way faster or slower than Dahl's own."""
    F = force(base) * log_uniform(rng, 0.06, 0.25)
    reach = half_step_m(base) * log_uniform(rng, 12.0, 60.0)
    machine = {"slip_force": F, "slip_length": reach}
    if rng.random() < 0.5:
        power = rng.uniform(0.7, 1.5)
        machine = {"bend_force": F, "bend_length": reach, "bend_power": power}
    return Hidden(
        "dahl_hysteresis",
        machine,
        truth={"torque_Nm": F * base.radius_m},
    )


def eyelet_friction(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a ratio
    hold = 1.0 - log_uniform(rng, 0.02, 0.12)
    return Hidden(
        "eyelet_friction",
        {"hold": hold, "inner": rng.uniform(0.2, 0.4)},
        truth={"attenuation": hold},
    )


def viscous_damping(rng: Rng, base: Base) -> Hidden:
    more = base.viscous_Nms * rng.uniform(0.8, 3.0)
    return Hidden(
        "viscous_damping",
        {"+drag": more / base.radius_m**2},
        truth={"damping_Nms": more},
    )


def dead_time(rng: Rng, base: Base) -> Hidden:
    """Mostly idle time; the rest in electronics that are late without being idle."""
    more, electronics = rng.uniform(0.6, 4.0) / base.rate_Hz, rng.uniform(0.1, 0.3)
    return Hidden(
        "dead_time",
        {"+delay": (1.0 - electronics) * more, "chain": electronics * more},
        truth={"delay_s": more + SOUND_LAG_s},
    )


def current_saturation(rng: Rng, base: Base) -> Hidden:
    limit = force(base) * (rng.uniform(2.2, 2.9) if base.kind == "reel" else rng.uniform(0.5, 0.8))
    return Hidden(
        "current_saturation",
        {"limit": limit, "limit_power": rng.uniform(16.0, 50.0)},
        truth={"limit_A": limit / base.newtons_per_ampere},
    )


def rate_limit(rng: Rng, base: Base) -> Hidden:
    slew = force(base) * log_uniform(rng, 30.0, 90.0)
    return Hidden(
        "rate_limit",
        {"slew": slew, "slew_soft": rng.uniform(3e-4, 6e-4)},
        truth={"rate_A_per_s": slew / base.newtons_per_ampere},
    )


def gain_error(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a ratio
    error = float(rng.choice([-1, 1]) * rng.uniform(0.05, 0.2))
    return Hidden("gain_error", {"*gain": 1.0 + error}, truth={"error": error})


def gauge_nonlinearity(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a reel's
    bend = float(rng.choice([-0.7, 1.0]) * log_uniform(rng, 2e-3, 5.5e-3))
    more = rng.uniform(-0.4, 0.4) / 40.0
    return Hidden("gauge_nonlinearity", {"gauge_bend": bend, "gauge_bend_more": more})


def gauge_offset(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a reel's
    shift = float(rng.choice([-1, 1]) * rng.uniform(0.4, 2.5))
    return Hidden("gauge_offset", instrument={"zero": shift}, truth={"offset_N": shift})


def gauge_drift(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a reel's
    return Hidden(
        "gauge_drift",
        instrument={
            "drift": float(rng.choice([-1, 1]) * log_uniform(rng, 0.15, 0.6)),
            "drift_s": rng.uniform(8.0, 25.0),
        },
    )


def gauge_resonance(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a reel's
    rate, damping = log_uniform(rng, 25.0, 90.0), rng.uniform(0.015, 0.06)
    return Hidden(
        "gauge_resonance",
        {
            "mode_share": rng.uniform(0.3, 0.8),
            "mode_rate": 2.0 * np.pi * rate,
            "mode_damping": damping,
        },
        truth={"frequency_Hz": rate},
    )


def cable_stiffening(rng: Rng, base: Base) -> Hidden:
    return Hidden(
        "cable_stiffening",
        {
            "stiffening": log_uniform(rng, 0.08, 0.3),
            "stiffening_at": 30.0 / base.stiffness(0.8),
            "stiffening_power": rng.uniform(0.8, 2.2),
        },
    )


def cable_creep(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a ratio
    share, first = rng.uniform(0.06, 0.25), log_uniform(rng, 0.08, 0.5)
    second = rng.uniform(0.2, 0.45)
    return Hidden(
        "cable_creep",
        {
            "slow1": share * (1.0 - second),
            "slow1_s": first,
            "slow2": share * second,
            "slow2_s": first * rng.uniform(3.0, 6.0),
        },
    )


def cable_slack(rng: Rng, base: Base) -> Hidden:
    toe = log_uniform(rng, 1.5, 5.0) / base.stiffness(0.8)
    return Hidden("cable_slack", {"toe": toe, "toe_width": toe * rng.uniform(0.35, 0.6)})


def cable_weight(rng: Rng, base: Base) -> Hidden:
    density = log_uniform(rng, 0.05, 0.15)
    ratio = ((base.density_kg_m + density) / base.density_kg_m) ** 2
    return Hidden("cable_weight", {"*sag": ratio}, truth={"density_kg_m": density})


def string_mode(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a reel's
    density, damping = log_uniform(rng, 0.05, 0.14), log_uniform(rng, 0.01, 0.06)
    return Hidden(
        "string_mode",
        {"string_mass": density, "string_damping": damping},
        truth={"density_kg_m": density},
    )


def structural_mode(rng: Rng, base: Base) -> Hidden:
    share, rate = rng.uniform(0.08, 0.4), log_uniform(rng, 18.0, 70.0)
    k = base.stiffness(0.8) / share
    mass = k / (2.0 * np.pi * rate) ** 2
    damping = rng.uniform(0.02, 0.08)
    return Hidden(
        "structural_mode",
        {
            "frame_stiffness": k,
            "frame_mass": mass,
            "frame_damping": 2.0 * damping * np.sqrt(k * mass),
            "frame_hardening": 0.1 / (30.0 / k) ** 2,
        },
        truth={"frequency_Hz": rate},
    )


def torque_ripple(rng: Rng, base: Base) -> Hidden:
    size = force(base) * log_uniform(rng, 0.03, 0.12)
    per_turn = float(rng.integers(6, 49) if base.kind != "reel" else rng.integers(40, 130))
    if base.kind == "stage":
        per_turn = 2.0 * np.pi / rng.uniform(0.004, 0.02)  # periods in 2 pi metres
    return Hidden(
        "torque_ripple",
        {
            "ripple1": size,
            "ripple2": size * rng.uniform(0.1, 0.25),
            "ripple_wave": per_turn / base.radius_m,
            "ripple_phase1": rng.uniform(-np.pi, np.pi),
            "ripple_phase2": rng.uniform(-np.pi, np.pi),
        },
        truth={"amplitude_Nm": size * base.radius_m, "per_turn": per_turn},
    )


def drum_eccentricity(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a ratio
    first = log_uniform(rng, 0.01, 0.06)
    return Hidden(
        "drum_eccentricity",
        {
            "round1": first,
            "round1_phase": rng.uniform(-np.pi, np.pi),
            "round2": first * rng.uniform(0.05, 0.2),
            "round2_phase": rng.uniform(-np.pi, np.pi),
        },
        truth={"eccentricity": first},
    )


def backlash(rng: Rng, base: Base) -> Hidden:
    """Two masses; the motor, which has the encoder, is one of them.

    Teeth as of a small planetary gear in oil, some tenths of a N m per minute of arc: on them the
    drum rings at 100 to 250 Hz, and comes back with less than half of the speed it met them with.
    """
    motor = rng.uniform(0.35, 0.65)
    mass, drag = base.machine(None)["mass"], base.machine(None)["drag"]
    play = log_uniform(rng, 0.01, 0.06) if base.kind != "stage" else log_uniform(rng, 5e-4, 3e-3)
    rate = 2.0 * np.pi * rng.uniform(100.0, 250.0)  # of the drum with the motor held
    far_mass, damping = (1.0 - motor) * mass, rng.uniform(0.2, 0.5)
    return Hidden(
        "backlash",
        {
            "*mass": motor,
            "*drag": 0.5,
            "far_mass": far_mass,
            "far_drag": 0.5 * drag,
            "far_dry": force(base) * rng.uniform(0.03, 0.06) if base.kind == "reel" else 0.0,
            "play": play * base.radius_m,
            "play_stiffness": far_mass * rate**2,
            "play_damping": 2.0 * damping * rate * far_mass,
        },
        truth={"play_rad": play},
    )


def quantisation(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a reel's
    step = log_uniform(rng, 0.25, 1.0)
    return Hidden("quantisation", {"gauge_step": step}, truth={"step_N": step})


def mains_interference(rng: Rng, base: Base) -> Hidden:  # noqa: ARG001  a reel's
    size = log_uniform(rng, 0.1, 0.5)
    rate = float(rng.choice([50.0, 60.0]) + rng.uniform(-0.05, 0.05))
    return Hidden(
        "mains_interference",
        instrument={"hum": size, "hum_Hz": rate, "hum_third": size * rng.uniform(0.05, 0.2)},
        truth={"amplitude_N": size, "frequency_Hz": rate},
    )


CATALOGUE: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        coulomb_friction,
        stribeck_friction,
        dahl_hysteresis,
        eyelet_friction,
        viscous_damping,
        dead_time,
        current_saturation,
        rate_limit,
        gain_error,
        gauge_nonlinearity,
        gauge_offset,
        gauge_drift,
        gauge_resonance,
        cable_stiffening,
        cable_creep,
        cable_slack,
        cable_weight,
        string_mode,
        structural_mode,
        torque_ripple,
        drum_eccentricity,
        backlash,
        quantisation,
        mains_interference,
    )
}
"""The effects that have a name in reports, of which cases are drawn."""


def directional_friction(rng: Rng, base: Base) -> Hidden:
    fast = {"reel": 0.06, "unloaded": 0.3, "stage": 0.25}[base.kind]
    more = float(rng.choice([-1, 1])) * force(base) * rng.uniform(0.1, 0.5) / fast
    truth = {"difference_Nms": more * base.radius_m**2}
    return Hidden("directional_friction", {"drag_one_way": more}, truth=truth)


def load_friction(rng: Rng, base: Base) -> Hidden:
    share = log_uniform(rng, 0.02, 0.1)
    return Hidden(
        "load_friction",
        {"dry_load": share, "bristle": half_step_m(base) * rng.uniform(0.4, 1.0)},
        truth={"load_share": share},
    )


def link_gravity(rng: Rng, base: Base) -> Hidden:
    size = force(base) * log_uniform(rng, 0.1, 0.4)
    phase = rng.uniform(-np.pi, np.pi)
    return Hidden(
        "link_gravity",
        {"ripple1": size, "ripple_wave": 1.0 / base.radius_m, "ripple_phase1": phase},
        truth={"torque_Nm": size * base.radius_m},
    )


def current_lag(rng: Rng, base: Base) -> Hidden:
    """A lag, of which a small part is electronics that are late otherwise."""
    lag, electronics = rng.uniform(1.0, 5.0) / base.rate_Hz, rng.uniform(0.02, 0.1)
    return Hidden(
        "current_lag",
        {"lag": (1.0 - electronics) * lag, "chain": electronics * lag},
        truth={"lag_s": lag + SOUND_LAG_s},
    )


FURTHER: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (directional_friction, load_friction, current_lag, link_gravity)
}
"""Effects with a name that are hidden only where a case asks for them: seeds drawn before stay."""
