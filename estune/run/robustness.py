"""Robustness of gains as the records of a run show it, or why nothing is claimed."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from estune.core.gains import Gains
from estune.loop_model.claim import Claim, claim
from estune.loop_model.identification import LoopFit, LoopRecord, fit_loop
from estune.loop_model.prediction import PredictedMargins
from estune.run.plan import step_trial
from estune.run.session import Plan
from estune.trial import RigDescription, TrialRecord
from estune.trial.loop_records import loop_signals

RECORDS_MAX = 20
"""Records that are fitted: the last ones of a run."""


class IdentifiedLoop(NamedTuple):
    """The loop identified from the records of a run.

    Attributes:
        fit: The fit; None where no record can be used.
        tried: Gains of the records that were fitted, in their order.
        reason: Why there is no fit; empty where there is one.
    """

    fit: LoopFit | None
    tried: tuple[Gains, ...] = ()
    reason: str = ""


def identify(records: Sequence[TrialRecord], plan: Plan, rig: RigDescription) -> IdentifiedLoop:
    """The loop identified from the last records of a run."""
    signals, tried, reason = list[LoopRecord](), list[Gains](), "there are no records of it"
    for record in records[-RECORDS_MAX:]:
        made = loop_signals(record, plan.step, rig)
        if made.record is None:
            reason = made.reason
        else:
            signals.append(made.record)
            tried.append(record.gains)
    if not signals:
        return IdentifiedLoop(None, reason=reason)
    fit = fit_loop(signals, rig.controller.sampling_Hz, plan.cost.settling_time_s)
    return IdentifiedLoop(fit, tuple(tried))


def claim_from(loop: IdentifiedLoop, plan: Plan, rig: RigDescription, gains: Gains) -> Claim:
    """The margins of some gains by an identified loop."""
    if loop.fit is None:
        return Claim(None, loop.reason, math.nan)
    return claim(loop.fit, step_trial(rig, plan.step, plan.cost), gains, loop.tried)


def robustness_cells(margins: PredictedMargins | None) -> Iterator[tuple[str, str]]:
    """Sensitivity and phase margin as text, by label."""
    if margins is None:
        yield from (("sensitivity Ms (records)", "-"), ("phase margin (records)", "-"))
        return
    Ms, angle = margins.sensitivity, margins.phase_margin_deg
    yield "sensitivity Ms (records)", f"{Ms.value:.2f} ({Ms.low:.2f} to {Ms.high:.2f})"
    yield "phase margin (records)", f"{angle.value:.0f}° ({angle.low:.0f} to {angle.high:.0f})"
