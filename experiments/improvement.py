"""Does `improve-model` end by itself, and does its model predict what gains cost on the rig?

Command: `python -m experiments.improvement`.
Target: all runs end by themselves, on the rig's own gains; costs are predicted within 5 %.

The rig is the emulated reel with the loop of hardware, in virtual time, and dry friction that a
seed draws. In each run it refuses two trials before they begin, one among the experiments and one
while it is tuned, because samples come late. The model begins as the reference reel, without
friction. Costs are compared at the rig's own gains and at those reached with the model.
"""

import copy
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

import plants
from estune.errors import EstuneError
from estune.hardware import HardwareRig
from estune.hardware.config import config_from
from estune.hardware.loop_messages import BeginTrial, LoopPlan
from experiments.results import at_least, at_most, command_line, print_results
from experiments.virtual_loop import VirtualLoop
from plants.emulator import RIG_FILE
from plants.improvement.tuning import ImprovementOptions

FRICTION_Nm = 0.01, 0.04
"""Range of the friction: the cable is taken up with 0.1 N m, of which 0.05 are tension."""
REFUSED, LATE_samples = (3, 16), 12
"""Which trials begin with so many late samples; the rig refuses one after ten."""


class Stuttering(VirtualLoop):
    """A loop in which the samples before some trials come late."""

    def __init__(self, name: str, plan: LoopPlan) -> None:
        super().__init__(name, plan)
        self.asked = 0

    def request(self, command: object, kind: type[Any], within_s: float) -> Any:
        """Executes a command."""
        if isinstance(command, BeginTrial):
            self.asked += 1
            self.late = LATE_samples if self.asked in REFUSED else 0
        return super().request(command, kind, within_s)


def rig(seed: int) -> tuple[HardwareRig, float]:
    """The emulated reel of a seed, and its friction, N m."""
    friction_Nm = float(np.random.default_rng(seed).uniform(*FRICTION_Nm))
    tables = copy.deepcopy(tomllib.loads(RIG_FILE.read_text()))
    settings = tables["driver"]["settings"]
    settings |= {
        "seed": seed,
        "effects": [{"name": "coulomb_friction", "torque_Nm": friction_Nm}],
    }
    return HardwareRig(config_from(tables, str(RIG_FILE)), Stuttering), friction_Nm


def improved(seed: int, options: ImprovementOptions) -> dict[str, Any]:
    """The figures of one run."""
    reel, friction_Nm = rig(seed)
    with reel, tempfile.TemporaryDirectory() as folder:
        live = reel.describe().gains
        try:
            found = plants.improve(reel, folder=Path(folder) / "x", tuning=options)
        except EstuneError as error:
            print(f"{seed}: {error}", file=sys.stderr)
            return {"friction_Nm": friction_Nm, "ended": False}
        own, *others = found.costs
        reached = others[0] if others else own
        print(f"{seed}: {found.conclusion}", file=sys.stderr)
        return {
            "friction_Nm": friction_Nm,
            "ended": True,
            "effects": ", ".join(found.added) or "none",
            "own_cost": own.measured,
            "own_error_%": 100.0 * own.error_improved,
            "reached_cost": reached.measured,
            "reached_error_%": 100.0 * reached.error_improved,
            "restored": reel.describe().gains == live == found.rig.gains,
        }


def main() -> int:
    """Runs, and prints; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="one run, with few trials")
    parser.add_argument("--runs", type=int, default=10, help="number of runs")
    options = parser.parse_args()
    runs = 1 if options.quick else options.runs
    few = ImprovementOptions(model_trials=20, rig_trials=4, watch=None)
    tuning = few if options.quick else ImprovementOptions(watch=None)
    rows = {f"run {seed}": improved(seed, tuning) for seed in range(runs)}
    ended = [row for row in rows.values() if row["ended"]]
    errors = [row[f"{which}_error_%"] for row in ended for which in ("own", "reached")]
    targets = {
        "ended": at_least(len(ended), runs),
        "restored": at_least(sum(row["restored"] for row in ended), runs),
        "greatest_error_%": at_most(max(errors, default=None), 5.0),
    }
    return print_results(rows, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
