"""Check of the way from the commanded current to the tension, by a step in an open loop."""

import math
from typing import NamedTuple

import numpy as np

from estune.cli.checks.check_result import CheckResult, fine, fix, unknown
from estune.trial import Outcome, RigDescription, TrialRecord
from estune.trial.profiles import StepProfile
from estune.trial.signals import TENSION

CHECK = "current loop"

QUIET_LEAST = 12
"""Fewest samples before and after a step that show its size."""

DETECTION = 4.0
"""Change that counts as a response, in standard deviations of the noise beyond its range."""

CLEAR_MAX = 0.2
"""Greatest such change relative to the step from which a delay can be read."""

AT_REST_MAX = 0.1
"""Maximum change in the last quarter of the record, relative to the step, of a tension at rest."""

SCALE_MAX = 0.2
"""Maximum relative deviation of the tension per current; friction hides a part of each step."""


class OpenStep(NamedTuple):
    """Response to a step of the current in an open loop.

    Attributes:
        change: Change of what is measured, from before the step to the last quarter.
        commanded_A: Step of the commanded current, A.
        at_rest: Whether the last quarter is at rest.
        delay_s: Time from the step until the measurement leaves its noise; NaN where the noise is
            too large or there is no response.
    """

    change: float
    commanded_A: float
    at_rest: bool
    delay_s: float


def expected_gain(rig: RigDescription) -> float | None:
    """Measurement at rest per effort commanded; None where it is not stated, or never at rest."""
    model = rig.linear_model
    if model is None:
        # Newtons per ampere are defined by it.
        return 1.0 if rig.measurement == TENSION else None
    if not model.A:
        return model.E
    A = np.array(model.A)
    if np.linalg.eigvals(A).real.max() >= 0.0:
        return None
    return model.E - float(np.array(model.C) @ np.linalg.solve(A, np.array(model.B)))


def check_current_loop(
    record: TrialRecord, step: StepProfile, rig: RigDescription, gain: float
) -> CheckResult:
    """Sign, scale and delay from the commanded current to what is measured."""
    if record.outcome is not Outcome.DONE:
        return fix(
            CHECK,
            f"a step of the current in an open loop: {record.outcome.sentence} ({record.reason})",
            "check the current's calibration C1 and the reel's torque constant",
        )
    first = step.step_index(record.sampling_Hz)
    if min(first, record.tension_N.size - first) < QUIET_LEAST:
        return unknown(CHECK, "there are too few samples before or after the step")
    return _judged(_response(record, first), rig, gain)


def _judged(found: OpenStep, rig: RigDescription, gain: float) -> CheckResult:
    """The result of a response.

    A loop with a dead time has a time constant of at least as much (Skogestad's SIMC rules), and
    settles in four of them.
    """
    effort = found.commanded_A * rig.newtons_per_ampere
    scale = found.change / (effort * gain) if effort * gain else math.nan
    figures = {"current_scale": scale, "current_delay_ms": 1e3 * found.delay_s}
    sentence = f"{rig.measured(found.change, 3)} after {found.commanded_A:+.3g} A"
    if math.isnan(scale) or abs(scale) < AT_REST_MAX:
        remedy = "check that the amplifier follows the commanded current"
        return fix(CHECK, f"{sentence}: no response", remedy, **figures)
    if scale < 0.0:
        return fix(CHECK, f"{sentence}: it pays out", "correct the sign of C1 or C2", **figures)
    share = "not at rest yet" if not found.at_rest else f"{100 * scale:.0f} % of what is stated"
    sentence = f"{sentence}, {share}"
    if found.at_rest and abs(scale - 1.0) > SCALE_MAX:
        remedy = "calibrate the current (C1), check torque constant, radius and friction"
        return fix(CHECK, sentence, remedy, **figures)
    hidden = math.isnan(found.delay_s)
    begins = "the noise hides its delay" if hidden else f"from {1e3 * found.delay_s:.2g} ms on"
    sentence = f"{sentence}, {begins}"
    if 4.0 * found.delay_s > rig.settling_time_s:
        return fix(
            CHECK,
            f"{sentence}: no loop with that dead time settles in {rig.settling_time_s:g} s",
            "shorten the way of the current command, use a faster gauge, move the loop to the "
            "board, or ask for a longer settling_time_s",
            **figures,
        )
    return fine(CHECK, sentence, **figures)


def _response(record: TrialRecord, first: int) -> OpenStep:
    before, after = record.tension_N[:first], record.tension_N[first:]
    early, late = np.array_split(after[3 * after.size // 4 :], 2)
    level = float(np.mean(before))
    change = float(np.mean(np.concatenate([early, late]))) - level
    commanded_A = record.current_A[-late.size :].mean() - record.current_A[first - 1]
    noise = float(np.std(np.diff(before))) / math.sqrt(2.0)
    threshold = DETECTION * noise + float(np.ptp(before)) / 2.0
    left = np.abs(after - level) > threshold
    clear = threshold < CLEAR_MAX * abs(change) and left.any()
    return OpenStep(
        change,
        float(commanded_A),
        bool(abs(late.mean() - early.mean()) < AT_REST_MAX * abs(change) + 2.0 * noise),
        float(np.argmax(left)) / record.sampling_Hz if clear else math.nan,
    )
