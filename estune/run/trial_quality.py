"""Whether a step trial is fit to be tuned by: noise in its cost, sampling, asked settling time."""

import math

import numpy as np

from estune.core.cost import StepCost
from estune.errors import InvalidInput
from estune.loop_model.loop_fit import LoopFit
from estune.run.plan import Plan
from estune.trial import RigDescription, TrialRecord

NOISE_SHARE_MAX, NOISE_SHARE_HIGH = 0.1, 0.03
"""Share of the noise in the cost from which a trial may be refused, and is warned of. On the
reference reel tuned from records they are reached by steps of 95 and 175 times the noise; the cost
at the proper step is then 39 % (step 80 times the noise) and 8 % (250) above the optimum."""

STEP_OVER_NOISE_MIN = 40.0
"""Step over noise from which no trial is refused for noise. Of six plants of `experiments.batch`,
seeds 900 and 901, whose initial gains had up to 94 % of noise in their cost, all 12 tunings with a
step of 50 times the noise ended within 4 % of the optimum of that cost; with one of 25 times it,
5 of 12 ended 6 to 48 % above."""

STEP_OVER_MOTION_MIN = 95.0
"""The same of the moves before the step where these are motion and not noise."""

SAMPLES_MIN, SAMPLES_LOW = 10.0, 25.0
"""Samples in the settling time below which a trial is refused, and warned of: the tuned reel has
Ms 14, 6.2, 4.7 at 5, 8, 10 samples, and 2.7, 2.1, 1.9 at 16, 24, 40."""

FEWEST_BEFORE = 8
"""Samples before the step that are enough to tell the noise of the effort."""

SETTLING_LEAST = 0.7
"""Asked settling time over the period 2 pi/omega of the plant's poles, below which a run warns.

At 0.15 to 0.5 the tuned reel has Ms 3.3 to 3.6."""


def check_sampling(cost: StepCost, sampling_Hz: float) -> None:
    """Refuses a settling time of too few samples.

    Raises:
        InvalidInput: it is shorter than `SAMPLES_MIN` samples.
    """
    samples = cost.settling_time_s * sampling_Hz
    if samples < SAMPLES_MIN:
        raise InvalidInput(
            f"the settling time of {cost.settling_time_s:g} s is {samples:.2g} samples, and "
            f"{SAMPLES_MIN:g} are needed for gains that can be trusted; ask for a longer settling "
            "time, sample faster, or force the run (--force)"
        )


def _shares(
    record: TrialRecord, plan: Plan, rig: RigDescription, cost: float
) -> tuple[float, float]:
    """Shares in the cost of all moves of the effort as before the step, and of the noise's alone.

    Zero where they are not known.
    The noise's are what the mean over seven moves leaves: the drift of a loop that is not at rest
    yet was called noise, 18 % of the cost of a trial without any.
    """
    index = plan.step.step_index(record.sampling_Hz)
    if index < FEWEST_BEFORE or not (math.isfinite(cost) and cost > 0.0):
        return 0.0, 0.0
    moves = np.diff(record.current_A[:index] * rig.newtons_per_ampere)
    width = min(FEWEST_BEFORE - 1, moves.size)
    drift = np.convolve(moves, np.full(width, 1.0 / width), "valid")
    noise = moves[width // 2 :][: drift.size] - drift
    if moves.size < 3 * width:  # too few about which a mean lies
        noise = moves - moves.mean()
    scale = plan.cost.move_weight * (len(record.current_A) - index) / plan.step.step_N**2 / cost
    return scale * float(np.mean(moves**2)), scale * float(np.mean(noise**2))


def _noise_before(record: TrialRecord, plan: Plan) -> tuple[float, int]:
    """Standard deviation of the noise before the step, and the samples that it is of."""
    before = record.tension_N[: plan.step.step_index(record.sampling_Hz)]
    noise = float(np.std(np.diff(before))) / math.sqrt(2.0) if before.size > 1 else 0.0
    return noise, before.size


def check_noise(record: TrialRecord, plan: Plan, rig: RigDescription, cost: float) -> None:
    """Refuses a trial whose cost is mostly noise, or which begins in motion.

    Raises:
        InvalidInput: the share of the noise, or of the motion, is above `NOISE_SHARE_MAX`.
    """
    moving, share = _shares(record, plan, rig, cost)
    (noise, samples), step = _noise_before(record, plan), abs(plan.step.step_N)
    in_motion = moving > NOISE_SHARE_MAX >= share
    if in_motion and step < STEP_OVER_MOTION_MIN * noise:
        raise InvalidInput(
            f"the loop is not at rest where trial {record.trial_id} steps: its effort moves "
            f"before that as much as {moving:.0%} of the cost; step later (step_at_s), begin at "
            "rest, or force the run (--force)"
        )
    # Two standard errors off the noise: by its estimate alone a proper trial is refused by chance.
    least = noise / (1.0 + 2.0 * math.sqrt(0.75 / max(samples, 1)))
    if share <= NOISE_SHARE_MAX or step >= STEP_OVER_NOISE_MIN * least:
        return
    larger = step * math.sqrt(share / NOISE_SHARE_HIGH)
    raise InvalidInput(
        f"noise makes up {share:.0%} of the cost of trial {record.trial_id}, more than "
        f"{NOISE_SHARE_MAX:.0%}: D would be tuned away; step by {rig.measured(larger, 2)} "
        "(--step-N), lower the move weight (--move-weight), or force the run (--force)"
    )


def quality_remarks(
    plan: Plan, rig: RigDescription, first: TrialRecord | None, cost: float, fit: LoopFit | None
) -> tuple[str, ...]:
    """Sentences on what makes the trials of a run doubtful.

    Args:
        first: Record of the first trial, or None.
        cost: Mean cost of the initial gains.
    """
    remarks = []
    share = 0.0 if first is None else _shares(first, plan, rig, cost)[1]
    if share > NOISE_SHARE_HIGH:
        remarks.append(
            f"noise makes up {share:.0%} of the cost of the initial gains: a larger step gives "
            "better gains"
        )
    samples = plan.cost.settling_time_s * rig.controller.sampling_Hz
    if samples < SAMPLES_LOW:
        remarks.append(
            f"the settling time is {samples:.0f} samples, fewer than {SAMPLES_LOW:g}: the gains "
            "are less robust than at a higher sampling rate"
        )
    period_s = math.inf if fit is None else fit.model.natural_period / rig.controller.sampling_Hz
    # A slower plant is not told from one with a pole at the origin, which has no period.
    shown = period_s < plan.step.duration_s - plan.step.step_at_s
    if shown and plan.cost.settling_time_s < SETTLING_LEAST * period_s:
        remarks.append(
            f"the settling time asked for, {plan.cost.settling_time_s:.2g} s, is short for a "
            f"plant with a period of {period_s:.2g} s: the gains trade robustness for speed"
        )
    return tuple(remarks)
