"""Checks on records of a few repeats of one step with the live gains."""

import math
import statistics
from collections.abc import Sequence

import numpy as np

from estune.cli.checks.check_result import CheckResult, fine, fix, unknown
from estune.core.cost import StepCost
from estune.errors import RigError
from estune.run.plan import MOVE_WEIGHT
from estune.trial import LATE, SATURATED, Outcome, RigDescription, TrialRecord
from estune.trial.profiles import StepProfile
from estune.trial.scoring import cost_of

LATE_MAX = 0.01
"""Share of samples that may be late."""

UNEVEN_MAX = 0.5
"""How far from its instant a sample may be, in sampling periods."""

NOISE_MAX = 0.05
"""Noise of the gauge as a share of the step."""

DRIFT_MAX = 0.05
"""How far levels may lie apart from repeat to repeat, as a share of the step."""

SCATTER_MAX = 0.1
"""Scatter of the cost as a share of it: a tuner sees no smaller difference in one trial."""

SATURATED_MAX = 0.2
"""Share of samples in which the effort may be at its limit."""


def check_outcomes(records: Sequence[TrialRecord], step: StepProfile) -> CheckResult:
    """Whether the trials ran to their end and every value is one."""
    for record in records:
        if record.outcome is not Outcome.DONE:
            return fix(
                "trials",
                f"{record.outcome.sentence} ({record.reason})",
                "see to the rig: these were its own gains and a gentle step",
            )
        asked = step.samples(record.sampling_Hz)
        names = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags")
        columns = {name: getattr(record, name) for name in names}
        wrong = [name for name, column in columns.items() if len(column) != asked]
        if wrong:
            return fix(
                "trials",
                f"{', '.join(wrong)} with another length than the {asked} samples asked for",
                "mend the rig's program, or the sampling rate that it says it has",
            )
        wrong = [name for name, column in columns.items() if not np.isfinite(column).all()]
        if wrong:
            return fix(
                "trials",
                f"values in {', '.join(wrong)} that are not finite",
                "see to the wiring and the calibration",
            )
    return fine("trials", f"{len(records)} repeats with the live gains ran to their end")


def check_sampling(records: Sequence[TrialRecord]) -> CheckResult:
    """Whether samples were taken when they should have been."""
    late = sum(int(np.count_nonzero(record.flags & LATE)) for record in records)
    samples = sum(len(record.flags) for record in records)
    uneven = max(
        float(np.max(np.abs(np.diff(record.time_s) * record.sampling_Hz - 1.0)))
        for record in records
    )
    rms_us = 1e6 * max(float(np.std(np.diff(record.time_s))) for record in records)
    figures = {
        "samples": float(samples),
        "late": float(late),
        "jitter_rms_us": rms_us,
        "uneven_max_periods": uneven,
    }
    sentence = (
        f"{late} of {samples} samples late, jitter {rms_us:.2g} us rms, "
        f"at most {100 * uneven:.2g} % of a period"
    )
    if late > LATE_MAX * samples or uneven > UNEVEN_MAX:
        return fix(
            "sampling",
            sentence,
            "give the loop real-time priority and a core of its own (docs/hardware.md), "
            "or a lower sampling rate",
            **figures,
        )
    return fine("sampling", sentence, **figures)


def check_gauge(
    records: Sequence[TrialRecord], step: StepProfile, *, simulated: bool
) -> CheckResult:
    """Whether the gauge is quiet, alive, and says the same from repeat to repeat."""
    height_N = abs(step.step_N)
    quiet = [r.tension_N[: step.step_index(r.sampling_Hz)] for r in records]
    if min(map(len, quiet)) < 3:
        return unknown("gauge", "the step leaves no time before it to look at the noise")
    # Differences of neighbours: what moves slowly is no noise.
    noise_N = math.sqrt(statistics.fmean(float(np.mean(np.diff(q) ** 2)) / 2.0 for q in quiet))
    levels = [float(np.mean(q)) for q in quiet]
    spread_N = max(levels) - min(levels)
    off_N = max(abs(level - step.preload_N) for level in levels)
    figures = {"noise_rms_N": noise_N, "level_spread_N": spread_N, "level_error_N": off_N}
    sentence = (
        f"noise {noise_N:.2g} N rms, levels {spread_N:.2g} N apart, at most {off_N:.2g} N from "
        "the setpoint"
    )
    if noise_N == 0.0 and not simulated:
        return fix(
            "gauge", "it reads exactly the same all the time", "see to its wiring", **figures
        )
    if noise_N > NOISE_MAX * height_N:
        remedy = "shield the gauge's cable and filter it, or ask for a larger step"
        return fix("gauge", sentence, remedy, **figures)
    if spread_N > DRIFT_MAX * height_N:
        remedy = "let the gauge and its amplifier warm up, and see to creep and play at its mount"
        return fix("gauge", sentence, remedy, **figures)
    if off_N > DRIFT_MAX * height_N:
        remedy = "calibrate the gauge, or leave more time before the step for the reel to settle"
        return fix("gauge", sentence, remedy, **figures)
    return fine("gauge", sentence, **figures)


def check_cost(
    records: Sequence[TrialRecord], step: StepProfile, rig: RigDescription
) -> CheckResult:
    """Whether the cost of the same gains is the same from repeat to repeat."""
    cost = StepCost(rig.settling_time_s, move_weight=MOVE_WEIGHT)
    try:
        costs = [cost_of(record, step, cost, rig.newtons_per_ampere) for record in records]
    except RigError as error:
        return fix("cost", str(error), "mend what the rig says of itself")
    mean = statistics.fmean(costs)
    scatter = statistics.stdev(costs) / mean if len(costs) > 1 and mean > 0.0 else math.nan
    saturated = max(float(np.mean((record.flags & SATURATED) > 0)) for record in records)
    figures = {"cost_mean": mean, "cost_scatter": scatter, "saturated_share": saturated}
    sentence = f"{mean:.3g}, scatter {100 * scatter:.2g} % over {len(costs)} repeats"
    if not math.isfinite(scatter):
        return unknown("cost", "there is no telling its scatter from these trials")
    if scatter > SCATTER_MAX:
        return fix(
            "cost",
            f"{sentence}: a tuner cannot tell smaller differences",
            "a larger or longer step (--step-N, --duration-s of estune tune), or more repeats",
            **figures,
        )
    if saturated > SATURATED_MAX:
        return fix(
            "cost",
            f"{sentence}, but the effort was at its limit for {100 * saturated:.0f} % of a trial",
            "a smaller step (--step-N of estune tune)",
            **figures,
        )
    return fine("cost", sentence, **figures)
