"""From a plan to what is handed over: columns and metadata of one record, or files of them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.hidden_machines import instruments
from experiments.hidden_machines.bases import Base, CURRENT_LOOP_s
from experiments.hidden_machines.batteries import RecordPlan
from experiments.hidden_machines.effects import Hidden
from experiments.hidden_machines.machine import DriveSignals, Run, run

Column = NDArray[np.float64]
Rng = np.random.Generator

CURRENT_NOISE_A = 2e-3


@dataclass(frozen=True, eq=False)
class MachineRecord:
    """Contents of one record that is handed over: plain columns and plain metadata."""

    columns: dict[str, Column]
    metadata: dict[str, Any]


@dataclass(frozen=True)
class CaseProperties:
    """Properties that the records of one case have in common.

    Attributes:
        actual: The machine as it is.
        believed: As its owner believes.
        hidden: What is hidden in it.
        gains: P, I, D and setpoint filter of the tension controller.
        noise: Factor of the noise.
        encoder: Whether there is an encoder.
        outside_gauge: Whether there is a gauge outside the eyelet.
        measured_current: Whether open-loop records have the current as measured.
    """

    actual: Base
    believed: Base
    hidden: tuple[Hidden, ...]
    gains: tuple[float, float, float, float]
    noise: float = 1.0
    encoder: bool = True
    outside_gauge: bool = False
    measured_current: bool = False


def machine(base: Base, hidden: tuple[Hidden, ...], length_m: float | None) -> dict[str, float]:
    """The parameters in force; those that begin with + or * change what is there."""
    made = base.machine(length_m)
    for effect in hidden:
        for name, value in effect.machine.items():
            if name[0] == "+":
                made[name[1:]] += value
            elif name[0] == "*":
                made[name[1:]] = made.get(name[1:], 0.0) * value
            else:
                made[name] = value
    if made.get("string_mass"):
        made["string_length"] = length_m or 0.0
    return made


def record(
    chance: tuple[Rng, Rng],
    bench: CaseProperties,
    plan: RecordPlan,
    length_m: float | None,
    *,
    number: int,
    warmth: float,
) -> tuple[MachineRecord, float]:
    """Takes one record; returns it and how warm the motor is after it.

    Of the two sources of chance the second serves what is hidden.
    """
    rng, own = chance
    base, samples = bench.actual, plan.setpoint.size
    rms = base.noise_N * bench.noise
    zero = float(rng.uniform(-2.0, 2.0))
    settings = machine(base, bench.hidden, length_m) | {"encoder_zero": zero}
    settings.setdefault("gauge_step", 2.0 ** -int(rng.choice([12, 16])) * 64.0)
    settings["lag"] = settings.get("lag", 0.0) + float(rng.uniform(*CURRENT_LOOP_s))
    settings |= _controller(base, plan, bench.gains)
    drive = DriveSignals(
        setpoint=plan.setpoint,
        added=base.zero_N
        + instruments.gauge_noise(rng, samples, rms)
        + _instrument(own, bench, samples),
        disturbance=instruments.disturbance(rng, samples, 0.3 * rms, base.rate_Hz)
        + _jolts(own, bench, samples)
        + (0.0 if plan.fed is None else plan.fed),
        scale=_scale(bench, samples),
    )
    rest = float(plan.setpoint[0]) if length_m is not None else 0.0
    done = run(settings, drive, base.rate_Hz, rest_N=rest, warmth=warmth)
    columns = _columns(chance, bench, plan, done, rms)
    about = {
        "rig": "bench",
        "trial_id": f"record-{number:02d}",
        "sampling_Hz": base.rate_Hz,
        "cable_length_m": length_m,
        "preload_N": rest,
        "loop": plan.loop,
        "gains": _gains(base, plan, bench.gains),
        "profile": plan.profile,
        "outcome": "done",
        "reason": "",
        "started_at": f"2024-05-13T09:{number:02d}:00+00:00",
        "software": "bench 3.1",
    }
    return MachineRecord(columns, about), done.warmth


def write(records: list[MachineRecord], folder: Path) -> None:
    """One CSV file per record, with JSON beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    for one in records:
        stem = folder / one.metadata["trial_id"]
        stem.with_suffix(".json").write_text(json.dumps(one.metadata, indent=1))
        lines = [",".join(one.columns)]
        rows = zip(*(column.tolist() for column in one.columns.values()), strict=True)
        lines += [",".join(map(repr, row)) for row in rows]
        stem.with_suffix(".csv").write_text("\n".join(lines) + "\n")


def _controller(
    base: Base, plan: RecordPlan, gains: tuple[float, float, float, float]
) -> dict[str, float]:
    if plan.loop == "open":
        return {}
    P, I, D, filtered = gains
    if base.kind == "reel":
        return {"control": 1.0, "P": P, "I": I, "D": D, "filter": filtered}
    # On the angle: a bandwidth of some 25 rad/s.
    inertia, speed = base.inertia_kg_m2 / base.radius_m, 25.0 * P / 0.4
    return {
        "control": 2.0,
        "P": inertia * speed**2,
        "I": inertia * speed**3 * 0.1,
        "D": inertia * speed * 1.4,
        "filter": 1e-3,
    }


def _gains(base: Base, plan: RecordPlan, gains: tuple[float, float, float, float]) -> Any:
    if base.kind != "reel" and plan.loop == "closed":
        return None  # nobody told
    return dict(zip(("P", "I", "D", "setpoint_filter_s"), gains, strict=True))


def _columns(
    chance: tuple[Rng, Rng], bench: CaseProperties, plan: RecordPlan, done: Run, rms: float
) -> dict[str, Column]:
    (rng, own), base, samples = chance, bench.believed, plan.setpoint.size
    force = done.command
    if bench.measured_current and plan.loop == "open":
        force = (
            done.force + rng.standard_normal(samples) * CURRENT_NOISE_A * base.newtons_per_ampere
        )
    columns = {"time_s": np.arange(samples) / base.rate_Hz}
    if base.kind == "reel":
        columns["setpoint_N"] = plan.setpoint
        columns["tension_N"] = done.tension
    elif plan.loop == "open":
        columns["setpoint_N"] = plan.setpoint
    columns["current_A"] = force / base.newtons_per_ampere
    if bench.encoder:
        columns["angle_rad"] = done.angle
    if bench.outside_gauge:
        columns["reference_N"] = done.outside + instruments.gauge_noise(rng, samples, rms)
    kept = _kept(own, bench, samples)
    for name in ("tension_N", "angle_rad"):
        if name in columns:
            columns[name] = columns[name][kept]
    return columns


def _instrument(rng: Rng, bench: CaseProperties, samples: int) -> Column:
    """Zero, drift and hum of the gauge."""
    t, out = np.arange(samples) / bench.actual.rate_Hz, np.zeros(samples)
    for effect in bench.hidden:
        about = effect.instrument
        out += about.get("zero", 0.0)
        if "drift" in about:
            out += about["drift"] * about["drift_s"] * -np.expm1(-t / about["drift_s"])
        if "hum" in about:
            phase = 2.0 * np.pi * (about["hum_Hz"] * t + rng.random())
            out += about["hum"] * np.sin(phase) + about["hum_third"] * np.sin(3.0 * phase + 1.0)
    return out


def _jolts(rng: Rng, bench: CaseProperties, samples: int) -> Column:
    rate, out = bench.actual.rate_Hz, np.zeros(samples)
    for effect in bench.hidden:
        if "jolt" in effect.instrument:
            width = round(0.03 * rate)
            for at in rng.integers(
                0, samples - width, rng.poisson(effect.instrument["jolts_per_s"] * samples / rate)
            ):
                out[at : at + width] += (
                    effect.instrument["jolt"] * rng.uniform(-1.5, 1.5) * np.hanning(width)
                )
    return out


def _scale(bench: CaseProperties, samples: int) -> Column | None:
    t = np.arange(samples) / bench.actual.rate_Hz
    for effect in bench.hidden:
        if "warming" in effect.instrument:
            about = effect.instrument
            grown: Column = 1.0 - about["warming"] * np.expm1(-t / about["warming_s"])
            return grown
    return None


def _kept(rng: Rng, bench: CaseProperties, samples: int) -> NDArray[np.int64]:
    """Which sample each row shows: its own, or where some were lost, the last before."""
    kept: NDArray[np.int64] = np.arange(samples)
    for effect in bench.hidden:
        if "lost" in effect.instrument:
            for at in np.flatnonzero(rng.random(samples) < effect.instrument["lost"]):
                end = min(samples, at + int(effect.instrument["lost_run"]))
                kept[at:end] = kept[max(0, int(at) - 1)]
    return kept
