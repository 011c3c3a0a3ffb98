"""What does it cost to decide by an identified loop, and to judge a loop by its records?

Command: `python -m experiments.loop_costs`.
Target: CPU time of a decision at most 30 ms median on the reference reel, 150 ms median and 1 s
worst on a plant of six poles, of a sweep of 80 cells 18 s, of a record of 10 000 samples 3 s, of
a folder of ten 10 s; memory linear in the samples.

A decision is what follows a trial that changes the model: the fit and the choice of the next
trial. Records are of the reference reel, busy, with and without friction; a folder has ten of
1000 samples. Memory is the peak of what is allocated while a record is judged.
"""

import math
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import plants
from estune.core.gains import Gains
from estune.run.loop import start
from estune.run.phase import Phase
from estune.run.planning import make_plan
from estune.run.session import next_request
from estune.service_records.sources import Logs
from estune.service_records.suggestion import suggest
from estune.studies.sweep.cells import expand_cells
from estune.studies.sweep.design import read_design
from estune.studies.sweep.executors import run_cell
from estune.support.blas import one_blas_thread
from experiments.loop_claims.cases import BASE_Hz, LoopCase, of_system
from experiments.loop_claims.search import advance
from experiments.results import Target, at_most, command_line, print_results
from experiments.sample_efficiency.problems import PROBLEMS, WEAK_ON_A_REEL, step_trial
from experiments.service_records.service import Service, serve
from plants.effects import CoulombFriction
from plants.simulation.plant import Plant
from plants.simulation.simulated_rig import SimulatedRig

TRIALS, NOISE, SEED = 24, 0.03, 1000
"""Most trials of a search, noise of the cost as a share of it, and the first seed."""

MODES = ((1.0, 0.2, 1.0), (4.7, 0.03, 0.05), (10.0, 0.01, 0.03))
"""Frequency over the slowest, damping and share of the three pairs of poles of a plant."""

FRICTION_Nm = 0.02
IN_USE = Gains(0.6, 15.0, 0.003, 0.02)
"""Gains of the records of service."""

LENGTHS_m = (0.5, 0.8, 1.1, 1.4)
_DESIGN = 'lengths_m = {lengths}\nrigs = ["plants:reference_reel"]\nseeds = {seeds}\n'


def cases() -> Iterator[LoopCase]:
    """The reference reel, and a plant of six poles."""
    import control  # noqa: PLC0415  slow to import

    yield LoopCase(
        "reel", "family", plants.reference_reel(), PROBLEMS["friction"].cost, WEAK_ON_A_REEL
    )
    modes = ((2.0 * math.pi * BASE_Hz * ratio, *shape) for ratio, *shape in MODES)
    parts = [control.tf([share * w * w], [1.0, 2.0 * d * w, w * w]) for w, d, share in modes]
    yield of_system("six poles", sum(parts[1:], parts[0]))


def decisions(case: LoopCase, seed: int) -> list[float]:
    """CPU time of each decision of a run, s."""
    rig, rng = SimulatedRig(case.plant, seed=seed, gains=case.start), np.random.default_rng(seed)
    description = rig.describe()
    run = start(
        make_plan(
            *(description, f"seed{seed}"),
            tuner="model_based",
            start=case.start,
            bounds=None,
            step=None,
            cost=case.cost,
            trials=TRIALS,
        ),
        description,
        None,
    )
    found = []
    while (request := next_request(run.session)) is not None:
        phase, record = run.session.phase, rig.run(request)
        factor, began_s = math.exp(NOISE * rng.standard_normal()), time.process_time()
        advance(run, record, factor)
        if phase in (Phase.EXCITE, Phase.SEARCH):
            found.append(time.process_time() - began_s)
    rig.close()
    return found


def sweep_s(cells: int) -> float:
    """CPU time of a sweep of so many cells by the default tuner, s."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sweep.toml"
        seeds = cells // len(LENGTHS_m)
        file.write_text(_DESIGN.format(lengths=list(LENGTHS_m), seeds=seeds), "utf-8")
        began_s = time.process_time()
        for cell in expand_cells(read_design(file)):
            run_cell(cell)
        return time.process_time() - began_s


def service_logs(plant: Plant, samples: int, count: int = 1) -> Logs:
    """Records of service of a reel."""
    trial = step_trial(plant, PROBLEMS["friction"].cost)
    rate = trial.controller.sampling_Hz
    service = Service("busy", samples / (trial.cost.settling_time_s * rate))
    records = (serve(plant, trial, IN_USE, service, SEED + n) for n in range(count))
    logs = (r.log(rate, IN_USE, f"record{n}") for n, r in enumerate(records))
    return Logs(tuple(logs), (), trial.controller)


def judging_s(logs: Logs) -> float:
    """CPU time of `suggest`, s."""
    began_s = time.process_time()
    suggest(logs)
    return time.process_time() - began_s


def judging_MB(logs: Logs) -> float:
    """Peak of the memory that `suggest` allocates, MB."""
    tracemalloc.start()
    suggest(logs)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def main() -> int:
    """Prints the figures, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="a run each, four cells, shorter records")
    parser.add_argument("--seeds", type=int, default=5, help="runs of each plant")
    parser.add_argument("--cells", type=int, default=80, help="cells of the sweep")
    options = parser.parse_args()
    quick = options.quick
    seeds = range(SEED, SEED + (1 if quick else options.seeds))
    reel, share = plants.reference_reel(), 10 if quick else 1
    figures: dict[str, float] = {}
    for case in cases():
        decisions(case, SEED - 1)  # loads what is loaded once
        took = [1e3 * s for seed in seeds for s in decisions(case, seed)]
        name = case.name.replace(" ", "_")
        figures |= {f"{name}_median_ms": float(np.median(took)), f"{name}_worst_ms": max(took)}
    figures["sweep_s"] = sweep_s(4 if quick else options.cells)
    figures["record_s"] = judging_s(service_logs(reel, 10_000 // share))
    rubbing = service_logs(reel + CoulombFriction(FRICTION_Nm), 10_000 // share)
    figures["record_with_friction_s"] = judging_s(rubbing)
    figures["folder_of_ten_s"] = judging_s(service_logs(reel, 1_000, 10))
    small, large = (judging_MB(service_logs(reel, n // share)) for n in (10_000, 100_000))
    figures |= {"record_MB": small, "ten_times_longer_MB": large}
    targets: dict[str, Target] = {
        "reel_median_ms": at_most(figures["reel_median_ms"], 30.0),
        "six_poles_median_ms": at_most(figures["six_poles_median_ms"], 150.0),
        "six_poles_worst_ms": at_most(figures["six_poles_worst_ms"], 1000.0),
        "sweep_s": at_most(figures["sweep_s"], 18.0),
        "record_s": at_most(figures["record_s"], 3.0),
        "record_with_friction_s": at_most(figures["record_with_friction_s"], 3.0),
        "folder_of_ten_s": at_most(figures["folder_of_ten_s"], 10.0),
        "memory_ratio": at_most(large / small, 12.0),
    }
    return print_results(figures, targets, as_json=options.json)


if __name__ == "__main__":
    with one_blas_thread():  # as runs of the product do
        raise SystemExit(main())
