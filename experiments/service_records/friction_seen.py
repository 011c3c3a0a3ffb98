"""Is friction seen where there is some, and not where the loop is linear?

Command: `python -m experiments.service_records.friction_seen`.
Target: at most 1 % of linear loops called a loop with friction; of loops whose friction is 0.5 %
of the effort's range and more, 90 % called so.

Logs of 1, 6 and 24 hours of masses on springs, damped or not, behind a dead time and before a lag,
under P, PI or PID with steps and ramps of the setpoint. What disturbs them is white noise at the
input, coloured noise of the sensor, or an encoder's steps, and a slow load.
"""

import math
import sys
import time
from typing import Any, NamedTuple

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.friction_score import hides_friction
from estune.loop_model.motion_score import changes_with_motion
from estune.service_records.identification import ServicePart, identify
from estune.service_records.stretches import Stretch
from experiments.results import at_least, at_most, command_line, print_results
from experiments.service_records.loops import Lags, Pid, Random, sensitivity, sound, wander

DISTURBED = ("input noise", "coloured noise", "encoder steps")
ROWS = {1: 3600, 6: 10800, 24: 21600}
"""Rows of the hours of a log: every 1, 2 and 4 s."""

SUBSTEPS = 8


class Mass(NamedTuple):
    """A mass on a spring, in samples.

    Attributes:
        pace: Angle of its resonance per sample.
        damping: Damping ratio, above one for two lags.
        lag: Lag behind it.
        dead: Samples of dead time.
    """

    pace: float
    damping: float
    lag: float
    dead: int

    def as_lags(self) -> Lags:
        """Lags for the rules of a sound controller."""
        slow = self.damping + math.sqrt(max(self.damping**2 - 1.0, 0.0))
        fast = max(2.0 * self.damping - slow, 0.3)
        lags = sorted((slow / self.pace, fast / self.pace, self.lag), reverse=True)
        return Lags(tuple(lags), integrating=False, dead_time=self.dead + 0.5, gain=1.0)


class MassLog(NamedTuple):
    """A simulated log, and the gains that ran, with I per sample."""

    setpoint: FloatArray
    measurement: FloatArray
    effort: FloatArray
    gains: Pid


def mass_of(random: Random) -> tuple[Mass, Pid]:
    """A plant, and a controller of Ms 1.1 to 1.9 by the SIMC rules."""
    while True:
        pace = math.exp(random.uniform(math.log(0.03), math.log(0.4)))
        damping = math.exp(random.uniform(math.log(0.5), math.log(3.0)))
        lag = random.choice([0.0, random.uniform(0.1, 0.6)]) / pace
        mass = Mass(pace, damping, lag, int(random.uniform(0.0, 1.5) / pace))
        pid = sound(random, mass.as_lags())
        if pid.I and 1.1 < sensitivity(mass.as_lags(), pid) < 1.9:
            return mass, pid


def run(
    mass: Mass, pid: Pid, setpoint: FloatArray, disturbed: tuple[FloatArray, ...], friction: float
) -> tuple[FloatArray, FloatArray]:
    """Measurement and effort under a load, noise and steps of the sensor, begun at rest."""
    load, noise, step = disturbed
    count, h = setpoint.size, 1.0 / SUBSTEPS
    y, u, late = np.zeros(count), np.zeros(count), [0.0] * mass.dead
    x = speed = level = total = before = 0.0
    square, drag = mass.pace**2, 2.0 * mass.damping * mass.pace
    for k in range(count):
        measured = level + float(noise[k])
        if step[k]:
            measured = round(measured / step[k]) * step[k]
        error = float(setpoint[k]) - measured
        total += pid.I * error
        u[k] = pid.P * error + total - pid.D * (measured - before)
        y[k] = before = measured
        late.append(u[k] + float(load[k]))
        push = late.pop(0)
        for _ in range(SUBSTEPS):
            speed = (speed + h * square * (push - x)) / (1.0 + h * drag)
            speed = math.copysign(max(abs(speed) - h * square * friction, 0.0), speed)
            x += h * speed
            level = level + h * (x - level) / mass.lag if mass.lag > h else x
    return y, u


def draw(seed: int, hours: int, disturbance: str, share: float) -> MassLog:
    """A log from a seed; friction as a share of the effort's range."""
    random = np.random.default_rng([seed, hours, DISTURBED.index(disturbance)])
    mass, pid = mass_of(random)
    rows, settling = ROWS[hours], 8.0 * mass.as_lags().pace
    setpoint, at, value = np.zeros(rows), 0, 0.0
    while at < rows:
        length = int(settling * random.uniform(1.0, 6.0))
        here = np.arange(min(length, rows - at))
        target = random.uniform(-1.0, 1.0)
        ramp = random.random() < 0.3
        wanted = value + (target - value) * here / length if ramp else np.full(here.size, target)
        setpoint[at : at + here.size] = wanted
        value, at = float(wanted[-1]), at + here.size
    load = wander(random, rows, settling * random.uniform(0.5, 4.0), random.uniform(0.003, 0.03))
    noise, step = 0.002 * random.normal(size=rows), np.zeros(rows)
    if disturbance == "input noise":
        load += random.uniform(0.02, 0.1) * random.normal(size=rows)
    elif disturbance == "coloured noise":
        correlation = math.exp(random.uniform(0.0, math.log(settling)))
        noise = wander(random, rows, correlation, random.uniform(0.003, 0.02))
    else:
        noise, step = 0.1 * noise, np.full(rows, random.uniform(0.005, 0.05))
    still = run(mass, pid, setpoint, (load, noise, step), 0.0)
    if not share:
        return MassLog(setpoint, *still, pid)
    friction = share * float(np.ptp(still[1]))
    return MassLog(setpoint, *run(mass, pid, setpoint, (load, noise, step), friction), pid)


def seen(log: MassLog) -> str:
    """By what friction is seen in a log; empty where it is not."""
    settings = ControllerSettings(
        1.0, 0.0, -math.inf, math.inf, ControllerForm(integral="backward")
    )
    gains = Gains(log.gains.P, log.gains.I, log.gains.D, 0.0)
    stretch = Stretch("log", 0.0, log.setpoint, log.measurement, log.effort)
    loop = identify([ServicePart(stretch, gains)], settings, None)
    if loop.fit.model.friction:
        return "identified"
    if hides_friction(loop.records, loop.fit, settings):
        return "hidden"
    return "motion" if changes_with_motion(loop.fit, loop.records, settings) else ""


def main() -> int:
    """Prints the table, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="one seed, of an hour")
    parser.add_argument("--seeds", type=int, default=3, help="loops of each length and noise")
    parser.add_argument("--seed0", type=int, default=1, help="first seed: see seeds.md")
    parser.add_argument("--shares", default="0,0.005,0.02", help="friction, of the effort's range")
    options = parser.parse_args()
    seeds = range(options.seed0, options.seed0 + (1 if options.quick else options.seeds))
    rows = list[dict[str, Any]]()
    for share in map(float, options.shares.split(",")):
        for disturbance in DISTURBED:
            found, begun = list[str](), time.process_time()
            for hours in [1] if options.quick else ROWS:
                for seed in seeds:
                    found.append(seen(draw(seed, hours, disturbance, share)))
                    print(share, disturbance, hours, seed, found[-1], file=sys.stderr, flush=True)
            cpu_s = (time.process_time() - begun) / len(found)
            row = {"friction": share, "disturbed by": disturbance, "loops": len(found)}
            counts = {name: found.count(name) for name in ("identified", "hidden", "motion")}
            rows.append({**row, **counts, "cpu_s": cpu_s})
    targets = {}
    for name, mine in (("false", [0.0]), ("seen", [r["friction"] for r in rows if r["friction"]])):
        chosen = [r for r in rows if r["friction"] in mine]
        count = sum(r["loops"] for r in chosen)
        share = sum(r[k] for r in chosen for k in ("identified", "hidden", "motion")) / max(
            count, 1
        )
        if count:
            targets[name] = at_most(share, 0.01) if name == "false" else at_least(share, 0.9)
    return print_results({"rows": rows}, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
