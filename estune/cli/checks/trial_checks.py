"""Checks of the records of repeated steps with the live gains."""

import math
import statistics
from collections.abc import Sequence

import numpy as np

from estune.cli.checks.check_result import CheckResult, fine, fix, unknown
from estune.core.cost import default_cost
from estune.core.quantities import FloatArray
from estune.errors import RigError
from estune.trial import LATE, SATURATED, Outcome, RigDescription, TrialRecord
from estune.trial.profiles import StepProfile
from estune.trial.records import COLUMNS
from estune.trial.scoring import cost_of

LATE_MAX = 0.01
"""Maximum share of late samples."""

UNEVEN_MAX = 0.5
"""Maximum deviation of a sampling interval, in sampling periods."""

NOISE_MAX = 0.05
"""Maximum noise of the gauge (rms), relative to the step."""

DRIFT_MAX = 0.05
"""Maximum difference of levels between repeats, relative to the step."""

DEVIATION_MAX = 0.1
"""Maximum relative standard deviation of the cost between repeats."""

SATURATED_MAX = 0.2
"""Maximum share of samples with the control effort at its limit."""


REPEATED_MAX = 0.02
"""Maximum share of readings that repeat the one before for want of a new one."""

RESOLVED_LEAST = 3.0
"""Least change of neighbouring readings (rms), in steps of the converter, that shows its rate."""


def check_outcomes(records: Sequence[TrialRecord], step: StepProfile) -> CheckResult:
    """Whether the trials ran to their end, with finite values."""
    for record in records:
        if record.outcome is not Outcome.DONE:
            return fix(
                "trials",
                f"{record.outcome.sentence} ({record.reason})",
                "check the rig: these were its own gains and a gentle step",
            )
        expected = step.samples(record.sampling_Hz)
        columns = {name: getattr(record, name) for name in (*COLUMNS, "flags")}
        wrong = [name for name, column in columns.items() if len(column) != expected]
        if wrong:
            return fix(
                "trials",
                f"{', '.join(wrong)} with another length than the {expected} samples requested",
                "correct the rig's software or its declared sampling rate",
            )
        wrong = [name for name, column in columns.items() if not np.isfinite(column).all()]
        if wrong:
            return fix(
                "trials",
                f"values in {', '.join(wrong)} that are not finite",
                "check the wiring and the calibration",
            )
    return fine("trials", f"{len(records)} repeats with the live gains ran to their end")


def check_sampling(records: Sequence[TrialRecord]) -> CheckResult:
    """Whether the sampling instants are regular."""
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
            "give the loop real-time priority and a core of its own, or a lower sampling rate",
            **figures,
        )
    return fine("sampling", sentence, **figures)


def check_gauge(
    records: Sequence[TrialRecord], step: StepProfile, rig: RigDescription
) -> CheckResult:
    """Noise, drift and calibration of the gauge."""
    height = abs(step.step_N)
    quiet = [r.tension_N[: step.step_index(r.sampling_Hz)] for r in records]
    if min(map(len, quiet)) < 3:
        return unknown("gauge", "there are too few samples before the step to estimate the noise")
    # Differences of neighbouring samples exclude slow changes.
    noise = math.sqrt(statistics.fmean(float(np.mean(np.diff(q) ** 2)) / 2.0 for q in quiet))
    levels = [float(np.mean(q)) for q in quiet]
    spread = max(levels) - min(levels)
    off = max(abs(level - step.preload_N) for level in levels)
    figures = {"noise_rms_N": noise, "level_spread_N": spread, "level_error_N": off}
    sentence = (
        f"noise {rig.measured(noise, 2)} rms, levels {rig.measured(spread, 2)} apart, "
        f"at most {rig.measured(off, 2)} from the setpoint"
    )
    if noise == 0.0 and not rig.simulated:
        return fix("gauge", "its reading never changes", "check its wiring", **figures)
    if noise > NOISE_MAX * height:
        remedy = "shield the gauge's cable and filter it, or ask for a larger step"
        return fix("gauge", sentence, remedy, **figures)
    if spread > DRIFT_MAX * height:
        remedy = (
            "let the gauge and its amplifier warm up, and check creep and backlash of its mount"
        )
        return fix("gauge", sentence, remedy, **figures)
    if off > DRIFT_MAX * height:
        remedy = "calibrate the gauge, or leave more time before the step for the reel to settle"
        return fix("gauge", sentence, remedy, **figures)
    return fine("gauge", sentence, **figures)


def check_gauge_rate(quiet: Sequence[FloatArray], sampling_Hz: float) -> CheckResult:
    """Rate of the gauge's converter, from readings that repeat the one before.

    With a resolution q and differences of neighbouring readings of standard deviation s, Gaussian
    noise repeats a reading with probability q / (s sqrt(2 pi)) by itself.

    Args:
        quiet: Readings at rest, at the sampling rate, in any unit; an array for each stretch.
        sampling_Hz: The sampling rate.
    """
    changes = np.concatenate([np.abs(np.diff(values)) for values in quiet])
    changes = changes[np.isfinite(changes)]
    changed = changes[changes > 0.0]
    if not changed.size:
        return unknown("gauge rate", "its reading does not change at rest")
    resolution, spread = float(changed.min()), math.sqrt(float(np.mean(changed**2)))
    by_noise = resolution / (spread * math.sqrt(2.0 * math.pi))
    repeated = 1.0 - changed.size / changes.size
    if spread < RESOLVED_LEAST * resolution:
        return unknown(
            "gauge rate", "its noise is below three steps of its converter, which hide its rate"
        )
    rate_Hz = sampling_Hz * min(1.0, (1.0 - repeated) / (1.0 - by_noise))
    figures = {"gauge_rate_Hz": rate_Hz, "repeated_share": repeated}
    if rate_Hz < (1.0 - REPEATED_MAX) * sampling_Hz:
        return fix(
            "gauge rate",
            f"{100 * repeated:.0f} % of the readings repeat the one before: the gauge delivers "
            f"about {rate_Hz:.3g} Hz, the loop runs at {sampling_Hz:.4g} Hz, and each reading is "
            f"up to {1e3 / rate_Hz:.2g} ms old, which is dead time",
            f"set the gauge's converter to {2 * sampling_Hz:.0f} Hz or more, or the loop to half "
            "of the converter's rate",
            **figures,
        )
    return fine("gauge rate", f"a new reading in each of {sampling_Hz:.4g} a second", **figures)


def check_cost(
    records: Sequence[TrialRecord], step: StepProfile, rig: RigDescription
) -> CheckResult:
    """Repeatability of the cost with the same gains."""
    cost = default_cost(rig.settling_time_s).scaled(rig.effort_scale)
    try:
        costs = [cost_of(record, step, cost, rig.newtons_per_ampere) for record in records]
    except RigError as error:
        return fix("cost", str(error), "correct the rig's description")
    mean = statistics.fmean(costs)
    deviation = statistics.stdev(costs) / mean if len(costs) > 1 and mean > 0.0 else math.nan
    saturated = max(float(np.mean((record.flags & SATURATED) > 0)) for record in records)
    figures = {"cost_mean": mean, "cost_scatter": deviation, "saturated_share": saturated}
    spread = f"standard deviation {100 * deviation:.2g} %"
    sentence = f"{mean:.3g}, {spread} over {len(costs)} repeats"
    if not math.isfinite(deviation):
        return unknown("cost", "its standard deviation cannot be computed from these trials")
    if deviation > DEVIATION_MAX:
        return fix(
            "cost",
            f"{sentence}: smaller differences are not significant",
            "use a larger or longer step (--step-N, --duration-s of estune tune), or more repeats",
            **figures,
        )
    if saturated > SATURATED_MAX:
        return fix(
            "cost",
            f"{sentence}, but {100 * saturated:.0f} % of a trial with saturated control effort",
            "use a smaller step (--step-N of estune tune)",
            **figures,
        )
    return fine("cost", sentence, **figures)
