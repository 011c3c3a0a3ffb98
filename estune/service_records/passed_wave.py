"""What of a wave from outside a loop lets pass, by the loop that the records identify."""

import math
from dataclasses import replace

import numpy as np

from estune.core.gains import Gains
from estune.loop_model.margins import loop_response
from estune.service_records.cause.judge import Cause
from estune.service_records.identification import ServiceLoop


def with_passed_wave(
    cause: Cause, loop: ServiceLoop | None, in_use: Gains, recommended: Gains | None
) -> Cause:
    """A cause with the shares of its wave that pass with two sets of gains.

    Only for a loop whose margins are known, else None: by the judge's own rough plant, gains of
    an unstable loop were to let 85 % pass.
    """
    if loop is None or cause.numbers.get("kind") != "period":
        return cause
    period_s = float(cause.numbers["period_s"] or math.inf)
    passes = _passed(loop, in_use, period_s)
    numbers = {**cause.numbers, "passes": passes}
    words = f"{cause.words}, and let {passes:.0%} of it pass"
    if recommended is not None:
        numbers["could_pass"] = _passed(loop, recommended, period_s)
        words = f"{words}, the recommended ones {numbers['could_pass']:.0%}"
    return replace(cause, numbers=numbers, words=words)


def _passed(loop: ServiceLoop, gains: Gains, period_s: float) -> float:
    """|S| at a period."""
    at = loop_response(loop.fit.model, gains, loop.settings)
    theta = 2.0 * math.pi / (period_s * loop.settings.sampling_Hz)
    return float(np.interp(theta, at.theta, 1.0 / np.abs(1.0 + at.loop)))
