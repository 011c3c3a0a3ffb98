"""What does each compensation of the hardware loop gain on an emulated reel with friction?

The loop, its controller and the emulated reel run in virtual time. The drum has the dry friction
(10) of the paper's demonstration; the cable is heavy, so that its weight can be seen. For each
compensation the reel is tuned with it on. Then the tension is held at 15 N while the far end of
the cable moves, slowly (10 mm at 1 Hz) and fast (2 mm at 5 Hz).

The error is that of the tension at the far end, by (6): |T_3| = |T_1| + mu g dz. Ms is that of
the reel's own linear part with these gains, without friction and without the compensation.
"""

import copy
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import estune
import plants
from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.hardware import HardwareRig
from estune.hardware.config import config_from
from estune.run.results.result import TuneResult
from estune.trial import Outcome, TrialRequest
from estune.trial.profiles import StepProfile
from estune.trial.scoring import cost_of
from experiments.loop_claims import true_sensitivity
from experiments.results import at_most, command_line, print_results
from plants.emulator import RIG_FILE
from plants.emulator.virtual_loop import virtual_rig

COULOMB_Nm, STATIC_Nm, STRIBECK_rad_s = 0.02, 0.03, 0.5
INERTIA_kgm2 = 2.0e-3
WEIGHT_N_m, RISE_m = 0.5, 0.6
"""A steel cable of 3 mm, and the height of its far end above the reel."""

_DRY = {"coulomb_Nm": COULOMB_Nm, "static_Nm": STATIC_Nm, "stribeck_rad_s": STRIBECK_rad_s}
_QUARTER = {"inertia_kgm2": 0.25 * INERTIA_kgm2}
COMPENSATIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "friction": {"friction": _DRY},
    "friction without static part": {"friction": _DRY | {"static_Nm": COULOMB_Nm}},
    "a quarter of the inertia": {"inertia": _QUARTER},
    "half of the inertia": {"inertia": {"inertia_kgm2": 0.5 * INERTIA_kgm2}},
    "friction, quarter of the inertia": {"friction": _DRY, "inertia": _QUARTER},
    "gravity": {
        "gravity": {
            "weight_N_m": WEIGHT_N_m,
            "rise_m": RISE_m,
            "length_min_m": 0.6,
            "length_max_m": 1.4,
        }
    },
}
FAST = Gains(0.78, 31.0, 0.0206, 0.0003)
"""Gains as the tunings find them, with which all are compared."""
MOTIONS = {
    "slow": {"amplitude_m": 0.010, "frequency_Hz": 1.0},
    "fast": {"amplitude_m": 0.002, "frequency_Hz": 5.0},
}
HOLD = StepProfile(preload_N=15.0, step_N=1.0, step_at_s=3.95, duration_s=4.0)
"""Holds the preload; the step comes after what is evaluated."""
BEGIN_s = 0.95
"""Whole periods of either motion are evaluated."""
REPEATS = 4


def rig(compensation: dict[str, Any], motion: Mapping[str, float] | None = None) -> HardwareRig:
    """The emulated reel with friction, a compensation, and a motion of its far end."""
    tables = copy.deepcopy(tomllib.loads(RIG_FILE.read_text()))
    settings = tables["driver"]["settings"]
    settings["effects"] = [
        {
            "name": "stribeck_friction",
            "coulomb_Nm": COULOMB_Nm,
            "excess_Nm": STATIC_Nm - COULOMB_Nm,
            "stribeck_rad_s": STRIBECK_rad_s,
        }
    ]
    settings["far_end"] = motion or {}
    tables["motion"]["take_up_A"] = 0.5  # more than the friction at rest
    tables["motion"]["settle_N"] = 12.0 if motion else 2.0
    if compensation:
        tables["compensation"] = compensation
    return virtual_rig(config_from(tables, str(RIG_FILE)))


def held_error_N(
    compensation: dict[str, Any], motion: Mapping[str, float], gains: Gains
) -> tuple[float, float]:
    """Mean and rms error of the tension at the far end while it moves, N; NaN where it stopped."""
    with rig(compensation, motion) as reel:
        record = reel.run(TrialRequest("hold", 0, gains, HOLD))
    if record.outcome is not Outcome.DONE:
        return np.nan, np.nan
    gauge = record.tension_N if record.gravity_N is None else record.tension_N + record.gravity_N
    at = slice(round(BEGIN_s * record.sampling_Hz), HOLD.step_index(record.sampling_Hz))
    error = (gauge + WEIGHT_N_m * RISE_m - record.setpoint_N)[at]
    return float(error.mean()), float(np.sqrt(np.mean(error**2)))


def mean_cost(compensation: dict[str, Any], gains: Gains) -> float:
    """Mean cost of repeated step trials."""
    with rig(compensation) as reel:
        about = reel.describe()
        cost = default_cost(about.settling_time_s)
        records = [reel.run(TrialRequest("c", n, gains, about.step)) for n in range(REPEATS)]
    costs = [cost_of(record, about.step, cost, about.newtons_per_ampere) for record in records]
    return float(np.mean(costs))


def tuned(compensation: dict[str, Any]) -> TuneResult:
    """A tuning with the compensation on."""
    with rig(compensation) as reel, tempfile.TemporaryDirectory() as folder:
        return estune.tune(reel, trials=40, folder=Path(folder), watch=None)


def held(compensation: dict[str, Any], gains: Gains) -> dict[str, float]:
    """Errors at the far end for each motion, and the cost of a step trial."""
    found = {name: held_error_N(compensation, motion, gains) for name, motion in MOTIONS.items()}
    rms = {f"{name}_rms_N": error[1] for name, error in found.items()}
    return {"mean_N": found["slow"][0], **rms, "cost": mean_cost(compensation, gains)}


def row(compensation: dict[str, Any], result: TuneResult) -> dict[str, Any]:
    """The figures of a tuning."""
    gains = dict(zip(("P", "I", "D", "filter_s"), result.gains.as_tuple(), strict=True))
    return {
        "trials": len(result.entries),
        **gains,
        "Ms": true_sensitivity(plants.reference_reel(), result.gains),
        **held(compensation, result.gains),
    }


def main() -> int:
    """Measures and prints; returns 1 where a target is missed."""
    arguments = command_line(__doc__, quick="no tunings, and three compensations").parse_args()
    quick = arguments.quick
    chosen = ("none", "friction", "gravity") if quick else COMPENSATIONS
    with rig({}) as reel:
        live = reel.describe().gains
    at_live = {name: held(COMPENSATIONS[name], live) for name in chosen}
    figures: dict[str, Any] = {"with the gains of the rig's file": at_live}
    if not quick:
        figures |= {
            f"with {FAST}": {name: held(one, FAST) for name, one in COMPENSATIONS.items()},
            "tuned with the compensation on": {
                name: row(one, tuned(one)) for name, one in COMPENSATIONS.items()
            },
        }
    none, friction = at_live["none"], at_live["friction"]
    targets = {
        "friction_slow_rms_ratio": at_most(friction["slow_rms_N"] / none["slow_rms_N"], 1.0),
        "gravity_mean_error_N": at_most(abs(at_live["gravity"]["mean_N"]), abs(none["mean_N"])),
    }
    return print_results(figures, targets, as_json=arguments.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
