"""Is a sticking actuator of a linear plant named, and none where there is none?

Command: `python -m experiments.sticking_actuators`.
Target: named in 90 % of the loops that have one, in none of the others.

Loops of two lags and a dead time under PI, three logs of steps and one of a slow sweep of the
setpoint each, noise of 1 % of the setpoint's steps. The model that is given has a gain and a lag
10 % too large. Seeds 0 to 19 are development; 500 on are sealed.
"""

import math
import sys
import time
from typing import Any, NamedTuple

import control
import numpy as np

import plants
from estune.core.quantities import FloatArray
from experiments.results import at_least, at_most, command_line, print_results
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.models.linear_plant import LinearPlant

SAMPLES, LOGS, SUBSTEPS = 500, 4, 4


class StickingLoop(NamedTuple):
    """A loop with an actuator of stick band and slip, the latter a share of the band.

    Attributes:
        lags: Two time constants, samples.
        late: Dead time, samples.
        gain: Of the plant.
        P: Proportional gain.
        I: Integral gain per sample.
        band: Stick band; zero where it does not stick.
        slip: Slip over the band.
    """

    lags: tuple[float, float]
    late: int
    gain: float
    P: float
    I: float
    band: float
    slip: float

    def believed(self) -> LinearPlant:
        """The model that is given."""
        lags = np.polymul([1.1 * self.lags[0], 1.0], [0.9 * self.lags[1], 1.0])
        return plants.linear_plant(control.tf([1.1 * self.gain], lags), float(self.late), 1.0)


def draw(seed: int, *, sticks: bool) -> tuple[LinearPlant, list[MeasuredRecord], StickingLoop]:
    """The model that is given, the logs, and the truth."""
    random = np.random.default_rng([77, seed])
    slow = random.uniform(5.0, 20.0)
    fast, late = max(random.uniform(0.0, 0.4) * slow, 0.3), round(random.uniform(0.1, 0.5) * slow)
    gain, closed = math.exp(random.uniform(-1.0, 1.5)), fast + late + 0.5
    P = random.uniform(0.5, 1.2) * slow / (2.0 * gain * closed)
    band = random.uniform(0.15, 1.0) / gain if sticks else 0.0
    I = P / min(slow, 8.0 * closed)
    loop = StickingLoop((slow, fast), late, gain, P, I, band, random.uniform(0.0, 1.0))
    records = [_log(loop, random, number) for number in range(LOGS)]
    return loop.believed(), records, loop


def _log(loop: StickingLoop, random: np.random.Generator, number: int) -> MeasuredRecord:
    times = np.arange(SAMPLES)
    setpoint: FloatArray = np.zeros(SAMPLES)
    for begin in range(10, SAMPLES, int(random.uniform(4.0, 8.0) * loop.lags[0])):
        setpoint[begin:] = random.uniform(-1.0, 1.0)
    if number == LOGS - 1:
        speeds = np.linspace(0.2, 1.5, SAMPLES) / (8.0 * loop.lags[0])
        setpoint = np.sin(2.0 * np.pi * np.cumsum(speeds))
    output, measurement = np.zeros(SAMPLES), np.zeros(SAMPLES)
    noise, late = 0.01 * random.normal(size=SAMPLES), [0.0] * (SUBSTEPS * loop.late)
    levels, at, integral = [0.0, 0.0], 0.0, 0.0
    holds, slides = 0.5 * loop.band * (1.0 + loop.slip), 0.5 * loop.band * (1.0 - loop.slip)
    for k in range(SAMPLES):
        measurement[k] = levels[1] + noise[k]
        error = setpoint[k] - measurement[k]
        output[k] = loop.P * error + integral
        integral += loop.I * error
        ahead = float(output[k]) - at
        if abs(ahead) > holds or not loop.band:
            at = float(output[k]) - math.copysign(slides, ahead)
        for _ in range(SUBSTEPS):
            late.append(at)
            x = loop.gain * late.pop(0)
            for i, lag in enumerate(loop.lags):
                levels[i] += min(1.0 / (SUBSTEPS * lag), 1.0) * (x - levels[i])
                x = levels[i]
    return MeasuredRecord(
        name=f"log-{number}",
        rig="rig",
        sampling_Hz=1.0,
        loop="open",
        time_s=times.astype(float),
        current_A=output,
        tension_N=measurement,
    )


def main() -> int:
    """Prints the table, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="two loops")
    parser.add_argument("--loops", type=int, default=20, help="loops with one and without")
    parser.add_argument("--seed0", type=int, default=0, help="first seed")
    options = parser.parse_args()
    seeds = range(options.seed0, options.seed0 + (2 if options.quick else options.loops))
    rows, named, off = list[dict[str, Any]](), {True: 0, False: 0}, list[float]()
    for seed in seeds:
        for sticks in (True, False):
            model, records, loop = draw(seed, sticks=sticks)
            begun = time.process_time()
            found = plants.explain(model, records)
            cpu_s = time.process_time() - begun
            effects = [effect.name for effect in found.effects]
            named[sticks] += "sticking_actuator" in effects
            row = {"seed": seed, "verdict": found.verdict, "effects": "+".join(effects)}
            values = {e.name: e.parameters for e in found.effects}.get("sticking_actuator")
            band = values["band_A"].value if values else math.nan
            if sticks and values:
                off.append(abs(band / loop.band - 1.0))
            rows.append({**row, "band": loop.band, "found": band, "cpu_s": cpu_s})
    targets = {
        "named": at_least(named[True] / len(seeds), 0.9),
        "falsely_named": at_most(named[False] / len(seeds), 0.0),
        "band_error_median": at_most(float(np.median(off)) if off else None, 0.05),
    }
    return print_results({"rows": rows}, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
