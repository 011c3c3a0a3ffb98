"""Loops of known cause that are unlike those which the weights of the judge were fitted to.

They have four to six lags, a dead time of three to eight times the lags, a resonance or an
inverse response, an output of few levels, limits of the output, a valve of equal percentages, or
noise with outliers and of all paces.
"""

import math

import numpy as np

from estune.core.quantities import FloatArray
from experiments.service_records.loops import (
    MATERIAL,
    DrawnLog,
    Lags,
    LoopRun,
    Pid,
    Random,
    sensitivity,
    setpoint_of,
    sound,
    wander,
)

CAUSES = ("sticking", "none")
KINDS = (
    "many lags", "dead time", "resonance", "inverse",
    "levels", "limits", "equal percentage", "noise",
)  # fmt: skip
SUBSTEPS = 4


def draw(seed: int, cause: str) -> DrawnLog:
    """A log of a loop whose cause is known, from a seed of its own, which decides its kind."""
    kind = KINDS[seed % len(KINDS)]
    for attempt in range(1000):
        log = _drawn(np.random.default_rng([seed, 20 + CAUSES.index(cause), attempt]), cause, kind)
        if log is not None:
            return log
    raise RuntimeError(f"no loop of seed {seed} shows {cause}")


def _drawn(random: Random, cause: str, kind: str) -> DrawnLog | None:
    """A log, or None where the actuator makes too little of a difference."""
    many = int(random.integers(4, 7)) if kind == "many lags" else int(random.integers(1, 3))
    lags = [math.exp(random.uniform(0.3, 2.3)) for _ in range(many)]
    late = random.uniform(3.0, 8.0) if kind == "dead time" else random.uniform(0.1, 1.0)
    plant = Lags(
        tuple(sorted(lags, reverse=True)), integrating=False, dead_time=late * sum(lags), gain=1.0
    )
    pid = sound(random, plant)
    if kind in ("resonance", "inverse", "equal percentage"):
        pid = pid.scaled(0.6)  # what the rules do not know of takes its share of the margin
    if not pid.I or not 1.1 < sensitivity(plant, pid) < 1.8:
        return None
    count, pace = int(np.clip(random.uniform(40.0, 120.0) * plant.pace, 400, 2000)), plant.pace
    setpoint = setpoint_of(random, count, pace, str(random.choice(("still", "steps", "few"))))
    load = wander(random, count, random.uniform(2.0, 20.0) * pace, random.uniform(0.02, 0.1))
    noise = 10.0 ** random.uniform(-2.7, -1.7) * random.normal(size=count)
    if kind == "noise":
        noise *= 1.0 / np.sqrt(random.chisquare(3.0, count) / 3.0)
        noise += sum(0.005 * wander(random, count, 4.0**k, 1.0) for k in range(5))
    band = random.uniform(0.15, 1.0) * float(cause == "sticking")
    slip = band * random.uniform(0.2, 1.0)
    state = random.bit_generator.state
    runs = []
    for valve in ((band, slip, 0.0), (0.0, 0.0, 0.0)):
        random.bit_generator.state = state
        runs.append(_run(random, (kind, plant, pid), LoopRun(setpoint, load, noise, valve)))
    (y, u), (quiet, _) = runs
    if not np.isfinite(y).all() or np.ptp(y) > 30.0:
        return None
    if band and np.std(setpoint - y) < MATERIAL * np.std(setpoint - quiet):
        return None
    return DrawnLog(cause, kind, 3.0 * setpoint + 50.0, 3.0 * y + 50.0, u + 40.0, {"band": band})


def _run(
    random: Random, loop: tuple[str, Lags, Pid], what: LoopRun
) -> tuple[FloatArray, FloatArray]:
    """Measurement and logged output under PI control without windup."""
    (kind, plant, pid), (band, slip, _), count = loop, what.valve, what.setpoint.size
    step, queue = 1.0 / SUBSTEPS, [0.0] * round(plant.dead_time * SUBSTEPS)
    level = random.uniform(0.05, 0.15) if kind == "levels" else 0.0
    most = random.uniform(0.4, 0.8) if kind == "limits" else math.inf
    pace = 2.0 / plant.pace
    lags, x, speed, total, at = [0.0] * len(plant.lags), 0.0, 0.0, 0.0, 0.0
    y, u = np.zeros(count), np.zeros(count)
    for k in range(count):
        seen = x - 0.5 * speed * plant.lags[0] if kind == "inverse" else x
        y[k] = seen + float(what.noise[k])
        error = float(what.setpoint[k]) - float(y[k])
        wanted = pid.P * error + total + pid.I * error
        output = min(max(wanted, -most), most)
        total += pid.I * error if output == wanted else 0.0
        output = round(output / level) * level if level else output
        u[k] = output
        if not band:
            at = output
        elif abs(output - at) > 0.5 * (band + slip):
            at = output - math.copysign(0.5 * (band - slip), output - at)
        flow = (3.0**at - 1.0) / math.log(3.0) if kind == "equal percentage" else at
        for _ in range(SUBSTEPS):
            queue.append(flow + float(what.load[k]))
            z = queue.pop(0)
            for i, lag in enumerate(plant.lags):
                lags[i] += min(step / lag, 1.0) * (z - lags[i])
                z = lags[i]
            if kind == "resonance":
                speed += step * (pace**2 * (z - x) - 0.6 * pace * speed)
                x += step * speed
            else:
                speed, x = (z - x) / step, z
    return y, u
