"""Does any short log end in something other than a verdict or a refusal in one line?

Command: `python -m experiments.service_records.short_logs --first SEED --logs N`.
Target: no other exception, no warning, at most 500 MB.

Random logs of 3 to 200 rows: a loop of one or two lags or an integrator with dead time under a P,
PI or PID controller with limits; or signals that are constant, ramps, noise or steps; with gaps,
with rows at a limit, reversed, without effort, in any units.
"""

import argparse
import json
import math
import resource
import time
import traceback
import warnings
from collections import Counter

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import EstuneError
from estune.recordings.loop_log import LoopLog
from estune.recordings.timing import Columns
from estune.service_records.suggestion import suggest

MEMORY_MB = 500.0


def loop_signals(rng: np.random.Generator, rows: int) -> tuple[dict[str, FloatArray], Gains]:
    """Setpoint, measurement and effort of a simulated loop, and its gains."""
    lags = np.exp(rng.uniform(-1.0, 6.0, 2)) * [1.0, rng.choice([0.0, 0.3])]
    integrates, dead = rng.random() < 0.3, int(rng.integers(0, 12))
    gain = math.exp(rng.uniform(-3.0, 3.0))
    P = math.exp(rng.uniform(-2.0, 1.5)) / gain
    gains = Gains(P, P * rng.choice([0.0, math.exp(rng.uniform(-6.0, -1.0))]), 0.0, 0.0)
    low, high = (0.0, 1.0 / gain) if rng.random() < 0.6 else (-math.inf, math.inf)
    setpoint = np.repeat(rng.uniform(0.0, 1.0, rows), max(rows // int(rng.integers(1, 6)), 1))[
        :rows
    ]
    noise, efforts = math.exp(rng.uniform(-9.0, -3.0)), np.zeros(rows + dead + 1)
    measurement, state, sums = np.zeros(rows), np.zeros(2), 0.0
    for k in range(rows):
        measurement[k] = state[1] + noise * rng.standard_normal()
        error = setpoint[k] - measurement[k]
        sums = min(max(sums + gains.I * error, low), high)
        efforts[k + dead + 1] = min(max(gains.P * error + sums, low), high)
        drive = gain * efforts[k + 1]
        state[0] += 0.1 * drive if integrates else (drive - state[0]) / (1.0 + lags[0])
        state[1] += (state[0] - state[1]) / (1.0 + lags[1])
    signals = {"setpoint": setpoint, "measurement": measurement, "effort": efforts[dead + 1 :]}
    return signals, gains


def any_signal(rng: np.random.Generator, rows: int) -> FloatArray:
    """A signal of no loop."""
    kind = rng.integers(5)
    level, size = rng.uniform(-100.0, 100.0), math.exp(rng.uniform(-9.0, 9.0))
    if kind == 0:
        return np.full(rows, level)
    if kind == 1:
        return level + size * np.linspace(0.0, 1.0, rows)
    if kind == 2:
        return level + size * rng.standard_normal(rows)
    if kind == 3:
        return np.asarray(level + size * np.round(np.cumsum(rng.standard_normal(rows))))
    return np.asarray(level + size * (np.arange(rows) > rng.integers(rows)))


def short_log(seed: int) -> tuple[LoopLog, Gains | None]:
    """A log, and the gains that are stated for it."""
    rng = np.random.default_rng(seed)
    rows, rate = int(rng.integers(3, 201)), math.exp(rng.uniform(-4.0, 7.0))
    signals, gains = loop_signals(rng, rows)
    if rng.random() < 0.3:
        signals = {name: any_signal(rng, rows) for name in signals}
    if rng.random() < 0.1:
        signals["effort"] = -signals["effort"]
    if rng.random() < 0.15:
        del signals["effort"]
    columns: Columns = {"time": np.arange(rows) / rate, **signals}
    parts: tuple[Columns, ...] = (columns,)
    if rng.random() < 0.2 and rows > 8:
        at = int(rng.integers(3, rows - 3))
        parts = ({n: v[:at] for n, v in columns.items()}, {n: v[at:] for n, v in columns.items()})
    of_time = Gains(gains.P, gains.I * rate, gains.D, 0.0)
    stated = of_time if "effort" not in signals or rng.random() < 0.6 else None
    return LoopLog(f"{seed}.csv", rate, parts, None, {}, {}, ()), stated


def verdict(seed: int) -> tuple[str, float]:
    """What `suggest` says of a log, and its CPU time, s."""
    log, gains = short_log(seed)
    begun = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            found = suggest([log], gains=gains, form=ControllerForm(integral="backward"))
            said = str(found.verdict)
            json.dumps(found.to_json())
            found.remarks()
        except EstuneError:
            said = "refused"
        except Exception:  # noqa: BLE001  what it may be is the question
            traceback.print_exc()
            said = f"failed: seed {seed}"
    return said, time.process_time() - begun


def main() -> int:
    """Prints how often each verdict is said; returns 1 where a log fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--logs", type=int, default=100)
    options = parser.parse_args()
    rows = [verdict(seed) for seed in range(options.first, options.first + options.logs)]
    said = Counter(one for one, _ in rows)
    cpu_s = sorted(seconds for _, seconds in rows)
    memory_MB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(dict(said), f"CPU median {cpu_s[len(cpu_s) // 2]:.2f} s, worst {cpu_s[-1]:.2f} s,")
    print(f"{memory_MB:.0f} MB")
    failed = any(one.startswith("failed") for one in said)
    return int(failed or memory_MB > MEMORY_MB)


if __name__ == "__main__":
    raise SystemExit(main())
