"""Initial gains from what is known of a rig: its linear model, earlier runs, a law over length."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estune.core import pidf
from estune.core.gains import GAIN_NAMES, Gains
from estune.core.margins import SampledPlant
from estune.core.quantities import FloatArray
from estune.core.sensitivity import largest_sensitivity
from estune.errors import InvalidInput, UnsafeStart
from estune.interop import model_gains, sampled_model
from estune.loop_model.fitting import fit_loop
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import robustness
from estune.loop_model.optimum import RegionSearch, RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.trial import RigDescription

SENSITIVITY_MAX = 2.0
"""Largest Ms, by the rig's linear model and by the first record, of gains that a run starts from
without having tried them on the rig."""

ROUNDS = 2
"""Identifications of the linear model: about the gains of the rule, then about the optimum."""

NOISE_ASSUMED = 0.004
"""Standard deviation of the measurement noise as a share of the step, which a description does not
give: that of the reference reel. Without noise the optimum costs 10 % more on that reel."""

EXTENT = 4.0
"""Greatest distance of the optimum from the gains of the rule, in the logarithm of each."""


@dataclass(frozen=True, slots=True)
class KnownStart:
    """Initial gains and where they come from, in words."""

    gains: Gains
    source: str


StartRule = Callable[[RigDescription, StepTrial, RobustnessLimits], KnownStart]
"""Initial gains for a rig, a step trial and the limits to be kept, as of `estune.start_from`."""


def left_out(start: Gains, tuned: tuple[str, ...], settling_time_s: float) -> str:
    """Which gains start at zero and are therefore not tuned, and how to include them; or nothing.

    The values proposed are a hundredth of the settling time for D over P and the setpoint filter,
    and an integral time of the settling time.
    """
    proposed = {
        "I": start.P / settling_time_s,
        "D": 0.01 * start.P * settling_time_s,
        "setpoint_filter_s": 0.01 * settling_time_s,
    }
    names = [name for name in proposed if not getattr(start, name) and name not in tuned]
    if not names:
        return ""
    options = " ".join(f"--start {name}={proposed[name]:.2g}" for name in names)
    plural = "start at zero and were" if len(names) > 1 else "starts at zero and was"
    return f"{' and '.join(names)} {plural} not tuned; to tune with: {options}"


def check_start(start: KnownStart, rig: RigDescription) -> None:
    """Refuses gains whose loop with the rig's linear model, if it gives one, is not robust.

    Raises:
        UnsafeStart: Ms is above `SENSITIVITY_MAX`.
    """
    if rig.linear_model is None:
        return
    plant = sampled_model(rig.linear_model, rig.controller)
    sensitivity = largest_sensitivity(plant, start.gains, rig.controller)
    if sensitivity > SENSITIVITY_MAX:
        raise UnsafeStart(_refusal(start.gains, sensitivity, "the rig's linear model"))


def first_record_fault(
    record: LoopRecord, gains: Gains, controller: pidf.ControllerSettings, settling_time_s: float
) -> str:
    """Why the record of the first trial refuses the initial gains; empty if it does not."""
    fit = fit_loop([record], controller.sampling_Hz, settling_time_s)
    sensitivity = robustness(fit.model, gains, controller).sensitivity
    if sensitivity <= SENSITIVITY_MAX:
        return ""
    return _refusal(gains, sensitivity, "the record of the first trial")


def _refusal(gains: Gains, sensitivity: float, by: str) -> str:
    size = f"{sensitivity:.2g}" if math.isfinite(sensitivity) else "infinite, an unstable loop"
    return (
        f"the start gains {gains} have a sensitivity Ms of {size} by {by}, more than "
        f"{SENSITIVITY_MAX:g}; start from the rig's own gains, or from gentler ones"
    )


def model_start(rig: RigDescription, trial: StepTrial, limits: RobustnessLimits) -> KnownStart:
    """The gains of least cost within limits, by the rig's own linear model.

    Its closed loop is simulated at the gains of `estune.interop.model_gains`, and the loop model
    identified from that record gives the optimum.

    Raises:
        InvalidInput: the rig gives no model, or one that the rule for the first gains refuses.
        UnsafeStart: no stable gains were found.
    """
    if rig.linear_model is None:
        raise InvalidInput(
            f"rig {rig.name} gives no linear model of itself; "
            "give the initial gains, or tune a model of it first (estune improve-model)"
        )
    free = replace(rig.controller, output_min_N=-math.inf, output_max_N=math.inf)
    trial = replace(trial, controller=free)
    plant = sampled_model(rig.linear_model, rig.controller)
    gains = _all_above_zero(model_gains(rig.linear_model, rig.controller), trial)
    records: list[LoopRecord] = []
    for _ in range(ROUNDS):
        records.append(simulated_step(plant, trial, gains))
        fit = fit_loop(records, rig.controller.sampling_Hz, trial.cost.settling_time_s)
        gains = _optimum(fit, trial, limits, gains)
    return KnownStart(gains, "the gains of the optimum of the rig's linear model")


def _all_above_zero(gains: Gains, trial: StepTrial) -> Gains:
    """The gains with the least D and setpoint filter that matter, where these are zero."""
    h = 1.0 / trial.controller.sampling_Hz
    return replace(gains, D=gains.D or gains.P * h, setpoint_filter_s=gains.setpoint_filter_s or h)


def _optimum(fit: LoopFit, trial: StepTrial, limits: RobustnessLimits, at: Gains) -> Gains:
    centre = np.log(at.as_tuple())
    search = RegionSearch(
        model=fit.model,
        trial=trial,
        limits=limits,
        gains_of=lambda x: Gains(*np.exp(x).tolist()),
        low=centre - EXTENT,
        high=centre + EXTENT,
        noise_std=NOISE_ASSUMED * abs(trial.step.size),
    )
    found = search.minimise([centre], scattered=64)
    if not math.isfinite(found.prediction.cost):
        raise UnsafeStart(
            "the rig's linear model has no stable gains near those of the rule; give the initial "
            "gains"
        )
    values = [float(f"{value:.6g}") for value in np.exp(found.coordinates).tolist()]
    return Gains(**dict(zip(GAIN_NAMES, values, strict=True)))


def simulated_step(plant: SampledPlant, trial: StepTrial, gains: Gains) -> LoopRecord:
    """The step trial on a linear plant at rest, without limits, as deviations from the preload."""
    c, state = pidf.coefficients(trial.controller, gains), pidf.state_at_rest(0.0, 0.0)
    x = np.zeros(plant.C.size)
    past = [0.0] * (plant.delay + 2)  # the latest effort first
    efforts, outputs = np.zeros(trial.samples), np.zeros(trial.samples)
    for k, r in enumerate(trial.setpoint.tolist()):
        y = float(plant.C @ x + plant.E * past[plant.delay])
        state, effort, _ = pidf.step(c, state, r, y)
        past = [float(effort), *past[:-1]]
        x = _moved(plant, x, past)
        efforts[k], outputs[k] = effort, y
    return LoopRecord(efforts, outputs, trial.setpoint, gains, at_rest=True)


def _moved(plant: SampledPlant, x: FloatArray, past: list[float]) -> FloatArray:
    now, before = past[plant.delay], past[plant.delay + 1]
    return np.asarray(plant.Phi @ x + plant.now * now + plant.before * before)
