"""Loops of known cause, in normalised units: one unit of measurement, at samples of one step.

Written without the product's simulation: lags in four Euler steps a sample, a PID on the error
with its derivative on the measurement, one fault at most.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray

Random = np.random.Generator
CAUSES = ("tuning", "sticking", "outside", "sensor", "none")

DETAILS = {
    "tuning": ("tight", "tight", "slow"),
    "sensor": ("steps", "frozen", "spikes", "noise"),
    "outside": ("period", "period", "step"),
}

MATERIAL = 1.5
"""Least factor by which a fault raises the error's rms; one that does less is no cause."""

SUBSTEPS = 4


class Lags(NamedTuple):
    """Lags and a dead time in samples, behind an integrator or not."""

    lags: tuple[float, ...]
    integrating: bool
    dead_time: float
    gain: float

    @property
    def pace(self) -> float:
        """Samples of its response."""
        return self.dead_time * (3.0 if self.integrating else 1.0) + sum(self.lags)

    @property
    def effort(self) -> float:
        """Output that moves the measurement by about one within its pace."""
        return 1.0 / abs(self.gain) / (self.pace if self.integrating else 1.0)


class Pid(NamedTuple):
    """Gains per sample."""

    P: float
    I: float
    D: float

    def scaled(self, factor: float, integral: float = 1.0) -> "Pid":
        """All gains times a factor, the integral one times another, too."""
        return Pid(self.P * factor, self.I * factor * integral, self.D * factor)


class DrawnLog(NamedTuple):
    """A simulated log.

    Attributes:
        cause: What is wrong.
        detail: Kind of it.
        setpoint: Setpoint.
        measurement: Measurement.
        output: Output of the controller.
        facts: What was drawn, for the table.
    """

    cause: str
    detail: str
    setpoint: FloatArray
    measurement: FloatArray
    output: FloatArray
    facts: dict[str, Any]


def sensitivity(plant: Lags, pid: Pid) -> float:
    """Ms by the frequency response of the sampled loop."""
    w = np.geomspace(1e-4, math.pi, 3000)
    back = np.exp(-1j * w)
    L = (
        plant.gain
        * np.exp(-1j * w * (plant.dead_time + 0.5))
        / (1j * w if plant.integrating else 1.0)
    )
    for lag in plant.lags:
        L = L / (1j * w * lag + 1.0)
    L = L * (pid.P + pid.I / (1.0 - back) * back + pid.D * (1.0 - back))
    return float(np.max(1.0 / np.abs(1.0 + L)))


def plant_of(random: Random, fastest: float = 1.5) -> Lags:
    """First to third order, a third of them integrating, some samples to 20 a response."""
    integrating = bool(random.random() < 0.35)
    count = int(random.integers(0, 3) if integrating else random.integers(1, 4))
    lags = [random.uniform(0.3, 1.0) for _ in range(count)]
    dead_time = random.uniform(0.1, 1.0) * (sum(lags) or 1.0)
    scale = math.exp(random.uniform(math.log(fastest), math.log(20.0))) / (dead_time + sum(lags))
    gain = random.choice([-1.0, 1.0]) * 10.0 ** random.uniform(-1.0, 1.0)
    scaled = tuple(sorted((lag * scale for lag in lags), reverse=True))
    return Lags(scaled, integrating, max(dead_time * scale, 0.3), gain)


def sound(random: Random, plant: Lags, slowest: float = 4.0) -> Pid:
    """P, PI or PID by the SIMC rules (Skogestad 2003), one to `slowest` times their dead time."""
    kinds = ("P", "PI", "PI", "PID") if plant.integrating else ("PI", "PI", "PID")
    kind = random.choice(kinds)
    lags = [*plant.lags, 0.0, 0.0]
    derivative = kind == "PID" and lags[int(not plant.integrating)] > 0.0
    late = plant.dead_time + 0.5
    first, rest = (0.0, lags) if plant.integrating else (lags[0], lags[1:])
    second = rest[0] if derivative else 0.0
    late += sum(rest) - second
    closed = late * math.exp(random.uniform(0.0, math.log(slowest)))
    if plant.integrating:
        P, integral = 1.0 / (plant.gain * (closed + late)), 4.0 * (closed + late)
    else:
        P = first / (plant.gain * (closed + late))
        integral = min(first, 4.0 * (closed + late))
    return Pid(P, 0.0 if kind == "P" else P / integral, P * second)


def wander(random: Random, count: int, correlation: float, deviation: float) -> FloatArray:
    """A signal of a correlation time in samples, shape (count,)."""
    keep = math.exp(-1.0 / correlation)
    white, x, level = random.normal(size=count), np.zeros(count), deviation * random.normal()
    for k in range(count):
        x[k] = level
        level = keep * level + deviation * math.sqrt(1.0 - keep * keep) * white[k]
    return x


def setpoint_of(random: Random, count: int, pace: float, kind: str) -> FloatArray:
    """A setpoint of some kind, shape (count,), for a loop of a pace in samples."""
    r = np.zeros(count)
    if kind == "steps":
        for at in range(int(8 * pace), count, int(random.uniform(15.0, 30.0) * pace) + 15):
            r[at:] = random.uniform(-0.5, 0.5)
    elif kind == "few":
        for at in random.integers(count // 8, count, random.integers(1, 4)):
            r[at:] += random.choice([-1.0, 1.0]) * random.uniform(0.1, 0.5)
    elif kind == "cascade":
        r = wander(random, count, random.uniform(2.0, 10.0) * pace, random.uniform(0.05, 0.2))
    elif kind == "dither":  # as the daemon adds it
        waves = np.arange(count) / (pace * np.geomspace(1.0, 30.0, 12)[:, np.newaxis])
        phases = random.uniform(0.0, 1.0, (12, 1))
        r = random.uniform(0.02, 0.1) * np.sin(2.0 * np.pi * (waves + phases)).sum(axis=0)
    elif kind == "ramps":
        times = np.sort(random.integers(0, count, 6))
        r = np.interp(np.arange(count), times, np.repeat(random.uniform(-0.4, 0.4, 3), 2))
    return r


class LoopRun(NamedTuple):
    """What acts on a loop while it runs."""

    setpoint: FloatArray
    load: FloatArray
    noise: FloatArray
    valve: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor: Callable[[int, float], float] | None = None


def run(random: Random, plant: Lags, pid: Pid, what: LoopRun) -> tuple[FloatArray, FloatArray]:
    """Measurement and output of a loop with a valve of static and sliding friction, and spread."""
    count, step = what.setpoint.size, 1.0 / SUBSTEPS
    y, u = np.zeros(count), np.zeros(count)
    late = [0.0] * round(plant.dead_time * SUBSTEPS)
    lags, level, integral, slope, before = [0.0] * len(plant.lags), 0.0, 0.0, 0.0, 0.0
    static, sliding, spread = what.valve
    at, holds = 0.0, static
    for k in range(count):
        x = level if plant.integrating or not lags else lags[-1]
        measured = x + float(what.noise[k])
        if what.sensor is not None:
            measured = what.sensor(k, measured)
        slope = 0.5 * slope + 0.5 * (measured - before)
        before, error = measured, float(what.setpoint[k]) - measured
        output = pid.P * error + integral - pid.D * slope
        integral += pid.I * error
        y[k], u[k] = measured, output
        if static == 0.0:
            at = output
        elif abs(output - at) > holds:
            at = output - math.copysign(sliding, output - at)
            holds = max(static * (1.0 + spread * random.normal()), 1.01 * sliding)
        for _ in range(SUBSTEPS):
            late.append(at + float(what.load[k]))
            z = plant.gain * late.pop(0)
            for i, lag in enumerate(plant.lags):
                lags[i] += min(step / lag, 1.0) * (z - lags[i])
                z = lags[i]
            level = level + step * z if plant.integrating else z
    return y, u


def material(
    random: Random,
    plant: Lags,
    faulty: tuple[LoopRun, Pid],
    sound: tuple[LoopRun, Pid] | None,
) -> tuple[FloatArray, FloatArray] | None:
    """Measurement and output of a loop; None where its fault makes too little of a difference."""
    (what, pid), state = faulty, random.bit_generator.state
    with np.errstate(all="ignore"):  # an unstable loop overflows, and is refused
        y, u = run(random, plant, pid, what)
    if not np.isfinite(y).all() or np.ptp(y) > 30.0:
        return None
    if sound is not None:
        random.bit_generator.state = state
        quiet, _ = run(random, plant, sound[1], sound[0])
        if np.std(what.setpoint - y) < MATERIAL * np.std(what.setpoint - quiet):
            return None
    return y, u


def tight(random: Random, plant: Lags, pid: Pid, by: float = 1.02) -> Pid:
    """More gain, or more integral, in steps up to an Ms of 3 to 9 on the stable side."""
    wanted, factor = random.uniform(3.0, 9.0), 1.0
    integral = random.choice([1.0, 1.0, 3.0]) if pid.I else 1.0
    while sensitivity(plant, pid.scaled(factor, integral)) < wanted and factor < 50.0:
        factor *= by
    return pid.scaled(factor / by, integral)


def _sensor(random: Random, kind: str, count: int, pace: float) -> Callable[[int, float], float]:
    if kind == "steps":
        size = random.uniform(0.1, 0.3)
        return lambda _k, value: round(value / size) * size
    if kind == "frozen":
        begin = int(random.uniform(0.2, 0.7) * count)
        end, held = begin + int(random.uniform(8.0, 20.0) * pace) + 25, list[float]()

        def freeze(k: int, value: float) -> float:
            if k == begin:
                held.append(value)
            return held[0] if begin <= k < end else value

        return freeze
    height, share = random.uniform(0.2, 0.6), random.uniform(0.005, 0.02)
    hit = np.where(random.random(count) < share, random.choice([-1.0, 1.0], count), 0.0)
    return lambda k, value: value + height * float(hit[k])


def _with_fault(
    random: Random,
    what: tuple[str, str],
    loop: tuple[Lags, Pid],
    usual: LoopRun,
    facts: dict[str, Any],
) -> tuple[LoopRun, Pid]:
    """What acts on a loop with a fault, and its gains."""
    (cause, detail), (plant, pid) = what, loop
    count, pace = usual.load.size, max(plant.pace, 1.0)
    if cause == "tuning":
        if detail == "tight":
            return usual, tight(random, plant, pid)
        return usual, pid.scaled(1.0 / random.uniform(8.0, 20.0))
    if cause == "sticking":
        band = plant.effort * math.exp(random.uniform(math.log(0.05), math.log(1.0)))
        slip = band * random.uniform(0.2, 1.0)
        facts |= {"band": band, "slip": slip}
        spread = float(random.choice([0.0, 0.05, 0.15]))
        return usual._replace(valve=(0.5 * (band + slip), 0.5 * (band - slip), spread)), pid
    if detail == "period":
        period = pace * 10.0 ** random.uniform(math.log10(1.5), math.log10(15.0))
        size = plant.effort * random.uniform(0.05, 0.5)
        facts |= {"period": period}
        wave = np.sin(2.0 * np.pi * np.arange(count) / period + random.uniform(0.0, 6.0))
        return usual._replace(load=usual.load + size * wave), pid
    if cause == "outside":
        added = usual.load.copy()
        for at in random.integers(count // 6, count - count // 8, random.integers(1, 4)):
            added[at:] += random.choice([-1.0, 1.0]) * random.uniform(0.3, 0.8) * plant.effort
        return usual._replace(load=added), pid
    if detail == "noise":
        high = random.uniform(0.3, 0.6) * max(float(np.ptp(usual.setpoint)), 0.3)
        usual = usual._replace(noise=high * random.normal(size=count))
    elif cause == "sensor":
        usual = usual._replace(sensor=_sensor(random, detail, count, pace))
    return usual, pid


def draw(seed: int, cause: str, noise_most: float = 0.02) -> DrawnLog:
    """A log of a loop whose cause is known, from a seed of its own.

    The seed decides what is wrong before any loop is drawn: a tight loop is material more seldom
    than a slow one, and two of three tight ones would become one of eleven.
    """
    number = CAUSES.index(cause)
    detail = str(np.random.default_rng([seed, number]).choice(DETAILS.get(cause, ("",))))
    for attempt in range(1000):
        log = _drawn(np.random.default_rng([seed, number, attempt]), cause, detail, noise_most)
        if log is not None:
            return log
    raise RuntimeError(f"no loop of seed {seed} shows {cause}")


def _drawn(random: Random, cause: str, detail: str, noise_most: float) -> DrawnLog | None:
    """A log, or None where the fault makes too little of a difference."""
    plant = plant_of(random)
    pid = sound(random, plant)
    Ms = sensitivity(plant, pid)
    if not 1.1 < Ms < 1.8:
        return None
    pace = max(plant.pace, 1.0)
    count = int(np.clip(random.uniform(60.0, 200.0) * pace, 400, 2000))
    moves = ("still", "still", "steps", "few", "cascade", "ramps")
    move = str(random.choice(moves)) if detail not in ("slow", "noise") else "steps"
    r = setpoint_of(random, count, pace, move)
    noise = 10.0 ** random.uniform(-3.0, math.log10(noise_most))
    slow = random.uniform(2.0, 20.0) * pace if random.random() < 0.7 else count / 5.0
    load = wander(random, count, slow, plant.effort * random.uniform(0.02, 0.1))
    readings = noise * random.normal(size=count)
    if random.random() < 0.3:
        readings += wander(random, count, math.exp(random.uniform(0.0, 3.0)), 0.7 * noise)
    usual = LoopRun(r, load, readings)
    facts: dict[str, Any] = {"noise": noise, "move": move, "integrating": plant.integrating}
    faulty, gains = _with_fault(random, (cause, detail), (plant, pid), usual, facts)
    compared = None if cause in ("none", "sensor") else (usual, pid)
    ran = material(random, plant, (faulty, gains), compared)
    if ran is None:
        return None
    y, u = ran
    facts |= {"Ms": sensitivity(plant, gains), "P": gains.P, "I": gains.I, "D": gains.D}
    size, offset = 10.0 ** random.uniform(-1.0, 2.0), random.uniform(20.0, 80.0)
    return DrawnLog(
        cause, detail, size * r + offset, size * y + offset, u + random.uniform(30.0, 60.0), facts
    )
