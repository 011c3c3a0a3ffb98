"""Does an improved model predict the costs of its rig, and is the rig kept where it is safe?

Three rigs: the reference reel with dry friction that its model lacks, served over Zenoh; the
emulated reel, in raw counts and real time; and a linear plant of 20 N/A that is known by its
description only. Each is improved; its costs are compared with those that the model predicts.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import control

import plants
from estune.errors import RigError
from estune.hardware import HardwareRig
from estune.hardware.config import read_config
from estune.remote import zenoh
from estune.trial import Outcome, RigLimits, record_frame
from estune.trial.profiles import StepProfile
from experiments.results import (
    Target,
    at_most,
    command_line,
    print_results,
    print_tables,
)
from plants.diagnosis.improvement.result import Improvement
from plants.diagnosis.improvement.tuning import ImprovementOptions
from plants.effects import CoulombFriction
from plants.emulator import RIG_FILE

PREDICTED_WITHIN = 0.05
"""Relative error allowed of a predicted cost."""
FRICTION_Nm = 0.05
TRIALS = {
    False: ImprovementOptions(watch=None),
    True: ImprovementOptions(model_trials=10, rig_trials=2, watch=None),
}
ATTEMPTS = 8
"""Calls of an improvement that a busy machine interrupts; each goes on where the last stopped."""


@contextmanager
def served_reel() -> Iterator[str]:
    """Endpoint of a reel with dry friction."""
    rig = (plants.reference_reel() + CoulombFriction(FRICTION_Nm)).rig(name="reel", seed=3)
    with zenoh.serve(rig) as server:
        yield server.endpoint


@contextmanager
def emulated_reel() -> Iterator[HardwareRig]:
    """The reel of the emulator, in a process of its own."""
    rig = HardwareRig(read_config(RIG_FILE))
    try:
        yield rig
    finally:
        rig.close()


PLANT_20_N_A = plants.linear_plant(
    control.tf([1440.0], [1.0, 40.0, 1600.0]),
    0.004,
    400.0,
    noise_rms_N=0.02,
    newtons_per_ampere=20.0,
    output_min_N=-120.0,
    output_max_N=120.0,
    limits=RigLimits(0.0, 40.0, 60.0),
    profile=StepProfile(15.0, 10.0, 0.2, 1.5),
    settling_time_s=0.2,
)
"""A plant that takes 20 N for an ampere; its rig is known by its linear model."""


@contextmanager
def linear_plant() -> Iterator[Any]:
    """The rig of the plant above."""
    yield PLANT_20_N_A.rig(seed=3)


RIGS = {"linear_plant": linear_plant, "served_reel": served_reel, "emulated_reel": emulated_reel}


def improved(rig: Any, folder: Path, tuning: ImprovementOptions) -> tuple[Improvement | None, int]:
    """The improvement of a rig, None where it never ends, and how often it was interrupted.

    Hardware that has stopped is cleared between the calls, as its operator does.
    """
    for interruptions in range(ATTEMPTS):
        try:
            return plants.improve(rig, folder=folder, tuning=tuning), interruptions
        except RigError as error:
            print(f"interrupted: {error}", flush=True)
            if isinstance(rig, HardwareRig):
                rig.clear()
    return None, ATTEMPTS


def figures_of(found: Improvement) -> dict[str, float | None]:
    """Errors of the predicted costs, and trials that ended outside what is safe."""
    records = [
        record_frame.decode(path.read_bytes()) for path in (found.folder / "records").iterdir()
    ]
    ended = sum(r.outcome in (Outcome.GUARD, Outcome.DIVERGED) for r in records)
    own, first = found.costs[0], found.costs[min(1, len(found.costs) - 1)]
    return {
        "effects": float(len(found.added)),
        "error_given": max(c.error_given for c in found.costs),
        "error_improved": max(c.error_improved for c in found.costs),
        "cost_own": own.measured,
        "cost_where_its_tuning_begins": first.measured,
        "trials_ended_by_a_guard": float(ended),
        "unsafe_trials_of_its_tuning": float(found.tuning.unsafe if found.tuning else 0),
    }


def main() -> int:
    """Runs the experiment from the command line."""
    parser = command_line(__doc__, quick="only the linear plant, with few trials")
    options = parser.parse_args()
    names = list(RIGS)[: 1 if options.quick else None]
    figures, targets = dict[str, Any](), dict[str, Target]()
    with print_tables(hidden=options.json), tempfile.TemporaryDirectory() as folder:
        for name in names:
            print(f"improving the {name.replace('_', ' ')}", flush=True)
            with RIGS[name]() as rig:
                found, count = improved(rig, Path(folder) / name, TRIALS[options.quick])
            one = figures[name] = figures_of(found) if found else dict[str, float | None]()
            one["interruptions"] = float(count)
            targets[f"{name}_error_improved"] = at_most(
                one.get("error_improved"), PREDICTED_WITHIN
            )
            targets[f"{name}_guarded"] = at_most(one.get("trials_ended_by_a_guard"), 0.0)
            targets[f"{name}_begins_no_worse"] = at_most(
                one.get("cost_where_its_tuning_begins"), 1.02 * (one.get("cost_own") or 0.0)
            )
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
