"""Is KEEP said of loops at their optimum, and CHANGE of others, and is either never false?

Command: `python -m experiments.service_records.keep`.
Target: no KEEP and no CHANGE is false, and KEEP is said of half of the loops at their optimum.

Loops of two lags and a dead time run in busy service, with the gains that the true plant makes
best within the limits, and with all gains 0.5 to 2 times these. The truth is that of the trial by
which `suggest` judges. KEEP is false where the gains in use break a limit or others within the
limits cost a fifth less; CHANGE where the recommended gains break one, or cost as much as those in
use, which keep them.
"""

import math
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.cost import cost_from
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.core.response import StepShape
from estune.loop_model.model import LoopModel, close_loop, exchanged
from estune.loop_model.optimum import RegionSearch, RobustnessLimits
from estune.loop_model.poles import pair_coordinates
from estune.loop_model.prediction import Prediction, StepTrial, predict
from estune.recordings.loop_log import LoopLog
from estune.service_records.sources import Logs
from estune.service_records.suggestion import TRIAL_SPAN, Suggestion, suggest
from experiments.results import at_least, at_most, command_line, print_results
from experiments.service_records.service import busy

LIMITS = RobustnessLimits()
SETTINGS = ControllerSettings(1.0, 0.0, -math.inf, math.inf, ControllerForm(integral="backward"))

LENGTH, BEGUN = 120.0, 10.0
"""Length of a record, and of what is cut before it, settling times."""

NOISE, LOAD = 0.004, 0.005
"""Noise of the measurement and load at the plant's input, as shares of the step."""

BEYOND_MS, BEYOND_OVERSHOOT = 0.05, 0.02
"""Share of Ms, and overshoot, up to which a limit is kept: a model's own error."""

FIFTH = 0.2


class LoopAtOptimum(NamedTuple):
    """A loop and its best gains within the limits."""

    plant: LoopModel
    trial: StepTrial
    best: Gains


class JudgedVerdict(NamedTuple):
    """What was said of one record.

    Attributes:
        at: Gains in use over the best.
        dearer: True cost of the gains in use over that of the best within the limits, less one.
        false: Why what was said is false; empty where it is true.
    """

    at: float
    said: str
    dearer: float
    false: str


def drawn(random: np.random.Generator) -> LoopAtOptimum:
    """A loop of two lags and a dead time, samples of one second."""
    first = math.exp(random.uniform(math.log(8.0), math.log(40.0)))
    second, dead = first * random.uniform(0.1, 0.8), round(first * random.uniform(0.05, 0.5))
    gain = 10.0 ** random.uniform(-1.0, 1.0)
    p, q = math.exp(-1.0 / first), math.exp(-1.0 / second)
    poles = tuple(pair_coordinates(-(p + q), p * q).tolist())
    taps = exchanged(np.array([gain * (1.0 - p) * (1.0 - q)]))
    plant = LoopModel(poles, tuple(taps.tolist()), dead)
    T = 2.0 * (first + second) + 4.0 * dead
    cost = cost_from("paper", T).scaled(plant.static_gain)
    trial = StepTrial(SETTINGS, cost, 0.0, StepShape(1, 1.0), math.ceil(TRIAL_SPAN * T) + 1)
    P = first / (gain * 2.0 * (second + dead + 1.0))  # SIMC (Skogestad 2003), twice as slow
    start = np.log([P, P / first, 0.3 * P * second, 0.05 * T])
    return LoopAtOptimum(plant, trial, _best(plant, trial, start))


def _best(plant: LoopModel, trial: StepTrial, start: FloatArray) -> Gains:
    search = RegionSearch(plant, trial, LIMITS, _gains_of, start - 3.0, start + 3.0, NOISE)
    return _gains_of(search.minimise([start], scattered=64).coordinates)


def _gains_of(x: FloatArray) -> Gains:
    return Gains(*np.exp(x).tolist())


def record(loop: LoopAtOptimum, gains: Gains, random: np.random.Generator) -> LoopLog:
    """Busy service with these gains, under a load and with noise."""
    T = loop.trial.cost.settling_time_s
    begun, samples = round(BEGUN * T), round((BEGUN + LENGTH) * T)
    closed = close_loop(loop.plant, gains, SETTINGS)
    setpoint, noise = busy(random, samples, T), NOISE * random.standard_normal(samples)
    level = LOAD / abs(loop.plant.static_gain)
    load = np.repeat(level * random.standard_normal(samples // 50 + 1), 50)[:samples]
    parts = (
        closed.setpoint_response(setpoint),
        closed.load_response(load),
        closed.noise_response(noise),
    )
    output, effort = (np.sum(pair, axis=0)[begun:] for pair in zip(*parts, strict=True))
    columns = {"time": np.arange(output.size) * 1.0, "setpoint": setpoint[begun:]}
    columns |= {"measurement": output, "effort": effort}
    return LoopLog("loop.csv", 1.0, (columns,), gains, {}, {}, ())


def judged(seed: int, *, at_optimum: bool) -> JudgedVerdict:
    """What is said of a loop, and whether it is true."""
    random = np.random.default_rng(seed)
    loop = drawn(random)
    factor = 1.0 if at_optimum else 2.0 ** random.uniform(-1.0, 1.0)
    best = loop.best
    in_use = Gains(factor * best.P, factor * best.I, factor * best.D, best.setpoint_filter_s)
    log = record(loop, in_use, random)
    if not np.abs(log.parts[0]["measurement"]).max() < 1e3:
        return JudgedVerdict(factor, "unstable", math.inf, "")
    T = loop.trial.cost.settling_time_s
    found = suggest(Logs((log,), (), SETTINGS), settling_time_s=T, step=1.0)
    now, at_best = (predict(loop.plant, loop.trial, gains, NOISE) for gains in (in_use, best))
    better = found.recommendation and predict(
        loop.plant, loop.trial, found.recommendation.gains, NOISE
    )
    dearer = now.cost / at_best.cost - 1.0
    result = JudgedVerdict(factor, found.verdict, dearer, _false(found, now, at_best, better))
    print(seed, *result, _shown(now), better and _shown(better), file=sys.stderr, flush=True)
    return result


def _shown(at: Prediction) -> str:
    return f"[{at.cost:.3g}, Ms {at.sensitivity:.3f}, {at.overshoot:.1%}]"


def _breaks(at: Prediction, *, by_any: bool = False) -> bool:
    Ms, overshoot = LIMITS.max_sensitivity, LIMITS.max_overshoot
    assert Ms is not None  # noqa: S101  both are set by default
    assert overshoot is not None  # noqa: S101
    if not by_any:
        Ms, overshoot = Ms * (1.0 + BEYOND_MS), overshoot + BEYOND_OVERSHOOT
    return not (at.sensitivity <= Ms and at.overshoot <= overshoot)


def _false(found: Suggestion, now: Prediction, best: Prediction, better: Prediction | None) -> str:
    if found.verdict == "keep":
        if _breaks(now):
            return "the gains kept break a limit"
        return "others cost a fifth less" if best.cost < (1.0 - FIFTH) * now.cost else ""
    if found.verdict == "change" and better is not None:
        if _breaks(better):
            return "the gains recommended break a limit"
        # Either may be said of gains that break a limit by less than the tolerance.
        if not _breaks(now, by_any=True) and better.cost >= now.cost:
            return "the gains recommended cost as much"
    return ""


def main() -> int:
    """Prints the table, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="two loops")
    parser.add_argument(
        "--loops", type=int, default=40, help="loops at and off their optimum each"
    )
    parser.add_argument("--seed0", type=int, default=0, help="first seed: see seeds.md")
    options = parser.parse_args()
    seeds = range(options.seed0, options.seed0 + (2 if options.quick else options.loops))
    at = [judged(seed, at_optimum=True) for seed in seeds]
    off = [judged(seed, at_optimum=False) for seed in seeds]
    rows = [_row(name, of) for name, of in (("at the optimum", at), ("0.5 to 2 times", off))]
    targets = {
        "false_keep": at_most(sum(row["false KEEP"] for row in rows), 0),
        "false_change": at_most(sum(row["false CHANGE"] for row in rows), 0),
        "kept_at_optimum": at_least(rows[0]["keep"] / len(at), 0.5),
    }
    return print_results({"rows": rows}, targets, as_json=options.json, tables=True)


def _row(name: str, of: Sequence[JudgedVerdict]) -> dict[str, Any]:
    said = [one.said for one in of]
    false = [one.said for one in of if one.false]
    counts = {verdict: said.count(verdict) for verdict in _VERDICTS}
    return {
        "gains": name,
        **counts,
        "false KEEP": false.count("keep"),
        "false CHANGE": false.count("change"),
    }


_VERDICTS = ("keep", "change", "cannot tell", "other gains ran", "unstable")


if __name__ == "__main__":
    sys.exit(main())
