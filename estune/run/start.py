"""Initial gains from what is known of a rig: its linear model, earlier runs, a law over length."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.margins import SampledPlant, largest_sensitivity
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, UnsafeStart
from estune.interop import sampled_model
from estune.loop_model.cautious_gains import SENSITIVITY_MAX as CAUTIOUS
from estune.loop_model.cautious_gains import cautious_gains
from estune.loop_model.fitting import fit_loop
from estune.loop_model.half_widths import HalfWidths
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import robustness
from estune.loop_model.optimum import Optimum, RegionSearch, RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.trial import RigDescription

SENSITIVITY_MAX = 2.0
"""Largest Ms, by the rig's linear model and by the first record, of gains that a run starts from
without having tried them on the rig."""

ROUNDS = 8
"""Most identifications of the linear model, each about the last optimum; 2 to 6 are needed."""

IMPROVEMENT = 0.01
"""Improvement of the predicted cost, as a share of it, below which the rounds end."""

NOISE_ASSUMED = 0.004
"""Standard deviation of the measurement noise as a share of the step, which a description does not
give: that of the reference reel. Without noise the optimum costs 10 % more on that reel."""

EXTENT = 2.5
"""Greatest distance of an optimum from the gains before, in the logarithm of each. With 4, and
two rounds, the searches from cautious gains ended in other optima, up to 45 % worse on a reel."""


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

    Its closed loop is simulated at cautious gains, or at the rig's own where there are none, as
    with an unstable plant. The loop model identified from that record gives the optimum.

    Raises:
        InvalidInput: the rig gives no model.
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
    gains = _cautious(plant, trial) or _own(rig, plant, trial)
    records: list[LoopRecord] = []
    cost = math.inf
    for _ in range(ROUNDS):
        records.append(simulated_step(plant, trial, gains))
        fit = fit_loop(records[-2:], rig.controller.sampling_Hz, trial.cost.settling_time_s)
        found, last = _optimum(fit, trial, limits, gains), cost
        gains, cost = Gains(*np.exp(found.coordinates).tolist()), found.prediction.cost
        if cost > (1.0 - IMPROVEMENT) * last:
            break
    rounded = Gains(*(float(f"{value:.6g}") for value in gains.as_tuple()))
    return KnownStart(rounded, "the gains of the optimum of the rig's linear model")


def _cautious(plant: SampledPlant, trial: StepTrial) -> Gains | None:
    settling_time_s, h = trial.cost.settling_time_s, 1.0 / trial.controller.sampling_Hz
    slow = min(2.0 * math.pi * h / settling_time_s, 3.0)

    def safe(gains: Gains) -> bool:
        return largest_sensitivity(plant, gains, trial.controller) <= CAUTIOUS

    response = plant.response(np.array([slow]))
    return cautious_gains(float(np.abs(response)[0]), settling_time_s, safe)


def _own(rig: RigDescription, plant: SampledPlant, trial: StepTrial) -> Gains:
    """The rig's own gains, with small ones in place of zero, which has no logarithm."""
    gains, h = rig.gains, 1.0 / rig.controller.sampling_Hz
    if not math.isfinite(largest_sensitivity(plant, gains, rig.controller)):
        raise UnsafeStart(
            f"the linear model of rig {rig.name} is unstable at the rig's own gains {gains}, and "
            "a slow PI does not hold it either; give the initial gains"
        )
    return replace(
        gains,
        I=gains.I or 0.1 * gains.P / trial.cost.settling_time_s,
        D=gains.D or gains.P * h,
        setpoint_filter_s=gains.setpoint_filter_s or h,
    )


def _optimum(fit: LoopFit, trial: StepTrial, limits: RobustnessLimits, at: Gains) -> Optimum:
    centre = np.log(at.as_tuple())
    search = RegionSearch(
        model=fit.model,
        trial=trial,
        limits=limits.aimed(HalfWidths.assumed(NOISE_ASSUMED)),
        gains_of=lambda x: Gains(*np.exp(x).tolist()),
        low=centre - EXTENT,
        high=centre + EXTENT,
        noise_std=NOISE_ASSUMED * abs(trial.step.size),
    )
    found = search.minimise([centre, *search.ends(centre)], scattered=64)
    if not math.isfinite(found.prediction.cost):
        raise UnsafeStart(
            "no stable gains were found for the rig's linear model; give the initial gains"
        )
    return found


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
