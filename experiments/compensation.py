"""What does each compensation of the hardware loop gain, at rest, in slow and in fast motion?

Command: `python -m experiments.compensation`.
Target: friction: error at most 1.2 times that without it at rest, 0.8 times in slow, 0.9 times in
fast motion; a far end of known motion at 5 Hz 10 times better.

The loop, its controller and the emulated reel run in virtual time. The drum has the dry friction
(10) of the paper's demonstration; the cable is heavy, so that its weight can be seen. For each
compensation the reel is tuned with it on.

Rest is the standard deviation of the tension in the last second after steps of 0.5, 2 and 10 N; a
compensation that makes the tension hunt shows there. Slow motion is a triangle of the setpoint at
1.5 N/s, fast motion one at 6 N/s. Then the tension is held at 15 N while the far end of the cable
moves, slowly (10 mm at 1 Hz) and fast (2 mm at 5 Hz): its velocity is announced to the loop, as a
source of setpoints does, or not.

The error is that of the tension at the far end, by (6): |T_3| = |T_1| + mu g dz; its mean, the
weight, stands beside its deviation in each motion. Ms is that of
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
from estune.core.quantities import FloatArray
from estune.hardware import HardwareRig
from estune.hardware.config import config_from
from estune.hardware.shared_memory import Word
from estune.run.results.result import TuneResult
from estune.trial import Outcome, TrialRequest
from estune.trial.profiles import StepProfile, TriangleProfile
from estune.trial.scoring import cost_of
from experiments.loop_claims import true_sensitivity
from experiments.results import at_most, command_line, print_results
from experiments.virtual_loop import VirtualLoop
from plants.emulator import RIG_FILE

COULOMB_Nm, STATIC_Nm, STRIBECK_rad_s = 0.02, 0.03, 0.5
INERTIA_kgm2, VISCOUS_Nms = 2.0e-3, 0.010
WEIGHT_N_m, RISE_m = 0.5, 0.6
"""A steel cable of 3 mm, and the height of its far end above the reel."""

FRICTION = {
    "name": "stribeck_friction",
    "coulomb_Nm": COULOMB_Nm,
    "excess_Nm": STATIC_Nm - COULOMB_Nm,
    "stribeck_rad_s": STRIBECK_rad_s,
}
_DRY = {
    "coulomb_Nm": COULOMB_Nm,
    "static_Nm": STATIC_Nm,
    "stribeck_rad_s": STRIBECK_rad_s,
    "tension_per_rad_N": 190.0,
}
_QUARTER = {"inertia_kgm2": 0.25 * INERTIA_kgm2}
COMPENSATIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "friction": {"friction": _DRY},
    "all of the friction": {"friction": _DRY | {"fraction": 1.0}},
    "1.2 of the friction": {"friction": _DRY | {"fraction": 1.2}},
    "a quarter of the inertia": {"inertia": _QUARTER},
    "half of the inertia": {"inertia": {"inertia_kgm2": 0.5 * INERTIA_kgm2}},
    "friction, quarter of the inertia": {"friction": _DRY, "inertia": _QUARTER},
    "friction, known motion of the far end": {
        "friction": _DRY,
        "known_motion": {"inertia_kgm2": INERTIA_kgm2, "viscous_Nms_rad": VISCOUS_Nms},
    },
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
    "far_slow": {"amplitude_m": 0.010, "frequency_Hz": 1.0, "begin_s": 4.0},
    "far_fast": {"amplitude_m": 0.002, "frequency_Hz": 5.0, "begin_s": 4.0},
}
HOLD = StepProfile(preload_N=15.0, step_N=1.0, step_at_s=7.95, duration_s=8.0)
"""Holds the preload; the far end begins to move, and the step comes after what is evaluated."""
BEGIN_s = 4.95
"""Whole periods of either motion are evaluated."""
STEPS_N = 0.5, 2.0, 10.0
TRIANGLES = {
    name: TriangleProfile(20.0, 3.0, period_s=12.0 / rate_N_s, start_s=0.2, duration_s=9.8)
    for name, rate_N_s in {"slow": 1.5, "fast": 6.0}.items()
}
REPEATS = 4


class AnnouncedEnd(VirtualLoop):
    """The loop with the velocity of the far end announced, as a source of setpoints does."""

    def sample(self) -> None:
        """One sample."""
        self.memory.far_end_m_s[0] = self.board.far_end_m_s
        self.memory.target_N[0], self.memory.target_rad[0] = HOLD.preload_N, np.nan
        self.memory.words[Word.SETPOINTS] += 1
        super().sample()


def rig(
    compensation: dict[str, Any],
    motion: Mapping[str, float] | None = None,
    *,
    announced: bool = False,
    friction: Mapping[str, Any] = FRICTION,
) -> HardwareRig:
    """The emulated reel with friction, a compensation, and a motion of its far end."""
    tables = copy.deepcopy(tomllib.loads(RIG_FILE.read_text()))
    settings = tables["driver"]["settings"]
    settings["effects"] = [dict(friction)]
    settings["far_end"] = motion or {}
    tables["motion"]["take_up_A"] = 0.5  # enough against the friction at rest
    if compensation:
        tables["compensation"] = compensation
    config = config_from(tables, str(RIG_FILE))
    return HardwareRig(config, AnnouncedEnd if announced else VirtualLoop)


def errors_N(
    reel: HardwareRig, gains: Gains, profile: StepProfile | TriangleProfile, begin_s: float
) -> FloatArray:
    """Errors of the tension at the far end from a time on, N; none where the trial stopped."""
    record = reel.run(TrialRequest("held", 0, gains, profile))
    if record.outcome is not Outcome.DONE:
        return np.array([np.nan])
    gauge = record.tension_N if record.gravity_N is None else record.tension_N + record.gravity_N
    end = slice(round(begin_s * record.sampling_Hz), None)
    if isinstance(profile, StepProfile) and profile is HOLD:
        end = slice(end.start, profile.step_index(record.sampling_Hz))
    return np.asarray((gauge + WEIGHT_N_m * RISE_m - record.setpoint_N)[end])


def rest_std_N(compensation: dict[str, Any], gains: Gains) -> float:
    """Greatest standard deviation of the tension in the last second after the steps, N."""
    found = []
    for step_N in STEPS_N:
        with rig(compensation) as reel:
            profile = StepProfile(15.0, step_N, 0.2, 3.0)
            found.append(float(np.std(errors_N(reel, gains, profile, 2.0))))
    return max(found)


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


def held(
    compensation: dict[str, Any], gains: Gains, announcements: tuple[bool, ...] = (False, True)
) -> dict[str, float]:
    """Rest, errors in each motion in N, announced or not, and the cost of a step trial."""
    found: dict[str, float] = {"rest_std_N": rest_std_N(compensation, gains)}
    for name, profile in TRIANGLES.items():
        with rig(compensation) as reel:
            error = errors_N(reel, gains, profile, 1.0)
            found[f"{name}_rms_N"] = float(np.std(error))
            found.setdefault("mean_N", float(error.mean()))
    for name, motion in MOTIONS.items():
        for announced in announcements:
            with rig(compensation, motion, announced=announced) as reel:
                error = errors_N(reel, gains, HOLD, BEGIN_s)
            found[f"{name}{'_announced' if announced else ''}_rms_N"] = float(np.std(error))
    return found | {"cost": mean_cost(compensation, gains)}


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
    arguments = command_line(__doc__, quick="no tunings, announced motion only").parse_args()
    quick = arguments.quick
    known = "friction, known motion of the far end"
    chosen = ("none", "friction", known, "gravity") if quick else COMPENSATIONS
    with rig({}) as reel:
        live = reel.describe().gains
    announcements = (True,) if quick else (False, True)
    at_live = {name: held(COMPENSATIONS[name], live, announcements) for name in chosen}
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
        "friction_rest_ratio": at_most(friction["rest_std_N"] / none["rest_std_N"], 1.2),
        "friction_slow_ratio": at_most(friction["slow_rms_N"] / none["slow_rms_N"], 0.8),
        "friction_fast_ratio": at_most(friction["fast_rms_N"] / none["fast_rms_N"], 0.9),
        "friction_far_slow_announced_ratio": at_most(
            friction["far_slow_announced_rms_N"] / none["far_slow_announced_rms_N"], 0.9
        ),
        "known_motion_far_fast_announced_ratio": at_most(
            at_live[known]["far_fast_announced_rms_N"] / none["far_fast_announced_rms_N"], 0.1
        ),
        "gravity_mean_error_N": at_most(abs(at_live["gravity"]["mean_N"]), abs(none["mean_N"])),
    }
    return print_results(figures, targets, as_json=arguments.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
