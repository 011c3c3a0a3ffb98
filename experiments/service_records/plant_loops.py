"""Loops as those of a plant, of known cause: wider than `loops`, to learn from.

They differ in what a logged plant loop has and a textbook loop has not: a process faster than its
samples under an integral up to sixty times as slow, so that the log holds few swings; friction
that varies from slip to slip; square waves from a loop upstream; drift; cascades; a historian that
repeats values until they moved. None of it was fitted to a measured log.
"""

import math

import numpy as np

from estune.core.quantities import FloatArray
from estune.service_records.cause.loop_signals import swings
from experiments.service_records.loops import (
    DrawnLog,
    Lags,
    LoopRun,
    Pid,
    Random,
    material,
    plant_of,
    sensitivity,
    setpoint_of,
    sound,
    tight,
    wander,
)

CAUSES = ("tuning", "sticking", "outside", "none")
DETAILS = {"outside": ("wave", "wave", "square", "step")}
FASTEST, SLOWEST = 0.3, 60.0

SWINGS = 3
"""Least swings of the output of a loop that sticks: a log of one reversal shows no cycle."""


def draw(seed: int, cause: str) -> DrawnLog:
    """A log of a loop whose cause is known, from a seed of its own, which decides its kind."""
    number = 10 + CAUSES.index(cause)
    detail = str(np.random.default_rng([seed, number]).choice(DETAILS.get(cause, ("",))))
    for attempt in range(1000):
        log = _drawn(np.random.default_rng([seed, number, attempt]), cause, detail)
        if log is not None:
            return log
    raise RuntimeError(f"no loop of seed {seed} shows {cause}")


def _pace(plant: Lags, pid: Pid) -> float:
    """Samples that the closed loop takes."""
    acts = abs(plant.gain * (pid.P if plant.integrating else pid.I))
    return max(plant.pace, 1.0 / acts, 1.0)


def _drawn(random: Random, cause: str, detail: str) -> DrawnLog | None:
    """A log, or None where the fault makes too little of a difference."""
    plant = plant_of(random, FASTEST)
    pid = sound(random, plant, SLOWEST)
    pace, count = _pace(plant, pid), int(random.integers(300, 1000))
    if not 1.0 < sensitivity(plant, pid) < 1.8 or count < 6.0 * pace:
        return None
    usual, noise = _usual(random, count, plant, pace)
    faulty, gains = _with_fault(random, (cause, detail), usual, plant, pace), pid
    if cause == "tuning":
        gains = tight(random, plant, pid, by=1.1)
    ran = material(random, plant, (faulty, gains), None if cause == "none" else (usual, pid))
    if ran is None or (cause == "sticking" and len(swings(ran[1])) < SWINGS):
        return None
    y, u = ran
    if random.random() < 0.3:
        y = _repeated(y, random.uniform(0.2, 1.5) * noise)
        u = _repeated(u, random.uniform(0.002, 0.01) * float(np.ptp(u)))
    size = 10.0 ** random.uniform(-1.0, 2.0)
    setpoint, measurement = (size * x + 50.0 for x in (usual.setpoint, y))
    return DrawnLog(cause, detail, setpoint, measurement, u + 40.0, {"noise": noise})


def _usual(random: Random, count: int, plant: Lags, pace: float) -> tuple[LoopRun, float]:
    """Setpoint, load and noise of a sound loop, and the noise's deviation."""
    move = str(random.choice(("still", "steps", "few", "few", "cascade", "ramps", "dither")))
    r = setpoint_of(random, count, pace if random.random() < 0.5 else plant.pace, move)
    load = wander(random, count, pace * 10.0 ** random.uniform(-0.5, 1.0), 1.0)
    load *= plant.effort * 10.0 ** random.uniform(-2.0, -0.5)
    noise = 10.0 ** random.uniform(-3.0, -1.2)
    readings = noise * random.normal(size=count)
    if random.random() < 0.5:
        readings += wander(random, count, math.exp(random.uniform(0.0, 3.0)), noise)
    return LoopRun(r, load, readings), noise


def _with_fault(
    random: Random, what: tuple[str, str], usual: LoopRun, plant: Lags, pace: float
) -> LoopRun:
    """What acts on a loop with a fault that is not its gains'."""
    cause, detail = what
    if cause == "sticking":
        band = plant.effort * math.exp(random.uniform(math.log(0.03), math.log(1.0)))
        slip = band * random.uniform(0.1, 1.0)
        spread = float(random.choice([0.0, 0.05, 0.15, 0.4]))
        return usual._replace(valve=(0.5 * (band + slip), 0.5 * (band - slip), spread))
    if cause == "outside":
        load = _from_outside(random, detail, usual.load.size, plant, pace)
        return usual._replace(load=usual.load + load)
    return usual


def _from_outside(random: Random, detail: str, count: int, plant: Lags, pace: float) -> FloatArray:
    """A load of one kind, shape (count,)."""
    size = plant.effort * 10.0 ** random.uniform(-1.3, -0.1)
    if detail == "step":
        load = np.zeros(count)
        for at in random.integers(count // 8, count - count // 8, random.integers(1, 5)):
            load[at:] += random.choice([-1.0, 1.0]) * random.uniform(0.5, 1.5) * size
        return load
    # A few per cent from period to period, as a cycle of another loop has.
    period = min(plant.pace * 10.0 ** random.uniform(0.3, 2.0), count / 4.0, 20.0 * pace)
    speed = 1.0 + random.choice([0.0, 0.03, 0.1]) * wander(random, count, period, 1.0)
    wave = np.sin(2.0 * np.pi * np.cumsum(speed) / period + random.uniform(0.0, 6.0))
    if detail == "square":
        wave = np.sign(wave + random.uniform(-0.3, 0.3))
    return np.asarray(size * wave)


def _repeated(x: FloatArray, least: float) -> FloatArray:
    """Values as a historian logs them that keeps one until it has moved."""
    kept, last = x.copy(), x[0]
    for k in range(1, x.size):
        if abs(x[k] - last) > least:
            last = x[k]
        kept[k] = last
    return kept
