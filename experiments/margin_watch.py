"""How soon is a changed plant noticed by 1 % dither, and how often a quiet loop taken for one?

Command: `python -m experiments.margin_watch`.
Target: a change of 30 % noticed within 2 minutes, no quiet loop taken for a changed one.

Loops of known plants are watched as the daemon watches them: its multisine, a record of 80
settling times a minute, and others at once after one that looks like another plant. Loads are 0.5
to 2 % of the step, noise is 0.4 %. After some quiet records the plant's inertia, cable length or
gain becomes 30 % larger, directly after a record, so that the first one of the changed plant ends
after a minute or more; of several such changes the longest time to the alarm is printed. The CPU
time of a record is that of its identification and its margins, without the rig's. With `--alarms`
only quiet records are judged, without margins, and the rate of false alarms is bounded.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.daemon.config import MarginsTable
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.service_records.watched_loop import WatchedLoop, judged_margins, observe
from experiments.loop_claims.truth import true_sensitivity
from experiments.results import at_least, at_most, command_line, print_results
from experiments.sample_efficiency.problems import PROBLEMS
from experiments.service_records.service import Service, serve
from plants.models.reel import Reel
from plants.simulation.plant import Plant

CHANGE = 1.3
LIMIT_S = 120.0
"""Time within which a change has to be noticed."""

LOOPS = {
    "reel 0.5 m": Gains(0.524, 9.85, 0.00816, 0.00585),
    "reel 1.4 m": Gains(0.482, 8.85, 0.00621, 0.013),
    "8 Hz": Gains(0.0906, 9.64, 0.00262, 0.0271),
    "20 Hz": Gains(0.161, 24.0, 0.000237, 0.00319),
    "dead time": Gains(0.0621, 6.34, 0.0037, 0.0128),
}
"""Gains half-way, in logarithms, between a weak start and the constrained optimum."""

SEEDS_APART = 50
"""Seeds from one change to the next: more than records within three times the limit."""

WARM = 6
"""Quiet records by which a loop is known before anything is counted."""


class WatchedCase(NamedTuple):
    """A loop that is watched.

    Attributes:
        plant: The plant, as it is at first.
        trial: Its step trial.
        gains: The gains in use.
    """

    plant: Plant
    trial: StepTrial
    gains: Gains

    def record(self, seed: int, gain: float = 1.0, plant: Plant | None = None) -> LoopRecord:
        """A record with 1 % dither, of another plant or of one of so many times the gain.

        A plant of higher gain makes the loop that gains higher by as much do, with less effort.
        """
        load = 0.01 * 2.0 ** np.random.default_rng(seed).uniform(-1.0, 1.0)
        P, I, D, F = self.gains.as_tuple()
        ran = Gains(gain * P, gain * I, gain * D, F)
        service = Service("advised 1 %", load=load)
        r = serve(plant or self.plant, self.trial, ran, service, seed)
        return LoopRecord(r.effort / gain, r.measurement, r.setpoint, self.gains)

    def changes(self) -> Iterator[tuple[str, Callable[[int], LoopRecord]]]:
        """Records of changed plants, by the name of the change."""
        if isinstance(self.plant, Reel):
            heavier = replace(
                self.plant, drum_inertia_kg_m2=CHANGE * self.plant.drum_inertia_kg_m2
            )
            longer = replace(self.plant, cable_length_m=CHANGE * self.plant.cable_length_m)
            yield "inertia", lambda seed: self.record(seed, plant=heavier)
            yield "cable length", lambda seed: self.record(seed, plant=longer)
        else:
            yield "gain", lambda seed: self.record(seed, gain=CHANGE)


def case_of(name: str) -> WatchedCase:
    """A loop of `LOOPS`."""
    problem = PROBLEMS[name]
    return WatchedCase(problem.plant, problem.trial, LOOPS[name])


def watched(name: str, quiet: int, repeats: int, seed0: int) -> dict[str, Any]:
    """What watching one loop shows: quiet records, then each change from the same state."""
    case = case_of(name)
    settings, settling_s = case.trial.controller, case.trial.cost.settling_time_s
    known, cpu_s, further, changed = WatchedLoop(), [], 0, 0
    for k in range(WARM + quiet):
        record = case.record(seed0 + k)
        begun = time.process_time()
        known, is_changed = observe(known, record, settings.sampling_Hz, settling_s)
        if not known.suspects:
            shown = judged_margins(known, case.trial, case.gains, settings)
        cpu_s.append(time.process_time() - begun)
        further += bool(known.suspects)
        changed += is_changed
    seed = seed0 + WARM + quiet
    while known.suspects:  # records follow each other at once until they are taken
        record = case.record(seed)
        known, is_changed = observe(known, record, settings.sampling_Hz, settling_s)
        seed, changed = seed + 1, changed + is_changed
    firsts = range(seed0 + 1000, seed0 + 1000 + SEEDS_APART * repeats, SEEDS_APART)
    times = {
        f"{change}, s": [noticed_s(case, known, record_of, seed) for seed in firsts]
        for change, record_of in case.changes()
    }
    every = [time_s for found in times.values() for time_s in found]
    Ms = shown.margins.sensitivity
    return {
        "loop": name,
        "true_Ms": true_sensitivity(case.plant, case.gains),
        "Ms": Ms.value,
        "low": Ms.low,
        "high": Ms.high,
        "told": shown.judgement.can_tell,
        "quiet": quiet,
        "hours": quiet * _every_s(record, settings.sampling_Hz) / 3600.0,
        "further": further,
        "false_alarms": changed,
        "cpu_s": float(np.median(cpu_s)),
        "changes": len(every),
        "noticed": float(np.mean([time_s <= LIMIT_S for time_s in every])),
    } | {change: max(found) for change, found in times.items()}


def alarms(name: str, quiet: int, seed0: int) -> dict[str, Any]:
    """False alarms of a quiet loop, and the rate that their number is below with 95 %.

    Records are made one by one, whichever are set apart, and the loop is not identified anew:
    alarms are told by the first fit.
    """
    case = case_of(name)
    rate, settling_s = case.trial.controller.sampling_Hz, case.trial.cost.settling_time_s
    known, further, changed, hours = WatchedLoop(), 0, 0, 0.0
    begun = time.process_time()
    for k in range(WARM + quiet):
        record = case.record(seed0 + k)
        took_s = record.samples / rate if known.suspects else _every_s(record, rate)
        known, is_changed = observe(known, record, rate, settling_s, refit=False)
        if k >= WARM:
            further += bool(known.suspects)
            changed += is_changed
            hours += took_s / 3600.0
    return {
        "loop": name,
        "quiet": quiet,
        "hours": hours,
        "further": further,
        "false_alarms": changed,
        "alarms_per_hour_below": most_events(changed) / hours,
        "cpu_s_per_hour": (time.process_time() - begun) / hours,
    }


def most_events(count: int) -> float:
    """Upper 95 % limit of the mean of a Poisson count: three for none."""
    from scipy.special import chdtri  # noqa: PLC0415  slow to import

    return 0.5 * float(chdtri(2 * count + 2, 0.05))


def noticed_s(
    case: WatchedCase, known: WatchedLoop, record_of: Callable[[int], LoopRecord], seed0: int
) -> float:
    """Time from a change to its alarm, infinite beyond three times the limit."""
    settings, settling_s = case.trial.controller, case.trial.cost.settling_time_s
    now_s, seed = 0.0, seed0
    while now_s <= 3.0 * LIMIT_S:
        record = record_of(seed)
        took_s = record.samples / settings.sampling_Hz
        now_s += took_s if known.suspects else _every_s(record, settings.sampling_Hz)
        known, is_changed = observe(known, record, settings.sampling_Hz, settling_s, refit=False)
        if is_changed:
            return now_s
        seed += 1
    return math.inf


def _every_s(record: LoopRecord, sampling_Hz: float) -> float:
    """Time from one record to the next, s, that the daemon's budget of dither allows."""
    table = MarginsTable()
    return max(table.every_s, record.samples / sampling_Hz / table.dither_time)


def _print_alarms(names: Sequence[str], quiet: int, seed0: int, *, as_json: bool) -> int:
    """The table of quiet loops, and what all of them say together."""
    rows = [alarms(name, quiet, seed0) for name in names]
    hours = math.fsum(row["hours"] for row in rows)
    count = sum(row["false_alarms"] for row in rows)
    figures = {
        "rows": rows,
        "hours": hours,
        "alarms_per_hour_below": most_events(count) / hours,
    }
    return print_results(
        figures, {"false_alarms": at_most(count, 0.0)}, as_json=as_json, tables=True
    )


def main() -> int:
    """Prints the table, or with --json one object; returns 1 where a target is missed."""
    parser: argparse.ArgumentParser = command_line(
        __doc__, quick="two loops, five quiet records of each"
    )
    parser.add_argument("--quiet", type=int, default=60, help="quiet records of each loop")
    parser.add_argument("--repeats", type=int, default=5, help="times that each change is tried")
    parser.add_argument("--seed0", type=int, default=1, help="first seed")
    parser.add_argument("--alarms", action="store_true", help="quiet records and alarms alone")
    options = parser.parse_args()
    names = list(LOOPS)[1:3] if options.quick else list(LOOPS)
    if options.alarms:
        return _print_alarms(names, options.quiet, options.seed0, as_json=options.json)
    quiet, repeats = (5, 2) if options.quick else (options.quiet, options.repeats)
    rows = [watched(name, quiet, repeats, options.seed0) for name in names]
    changes = sum(row["changes"] for row in rows)
    noticed = sum(row["noticed"] * row["changes"] for row in rows) / changes
    cpu_s = float(np.mean([row["cpu_s"] for row in rows]))
    figures = {
        "rows": rows,
        "hours": math.fsum(row["hours"] for row in rows),
        "cores_25_rigs": 25.0 * cpu_s / 60.0,
        "cores_100_rigs": 100.0 * cpu_s / 60.0,
    }
    targets = {
        "noticed": at_least(noticed, 1.0),
        "false_alarms": at_most(sum(row["false_alarms"] for row in rows), 0.0),
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
