"""Result of a run in words: its heading, the before/after table, conclusion and warnings.

The ending is shown first everywhere, and only a run with a significant improvement has a column
"tuned".
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from estune.loop_model.claim import MISFIT_MAX, unexplained
from estune.run.ending import RunEnding
from estune.run.robustness import limit_price, robustness_cells
from estune.run.run_result import RunResult
from estune.run.start import left_out
from estune.run.trial_quality import quality_remarks

OVERSHOOT_ALLOWED = 0.02
"""Overshoot beyond its limit that is not told, as a share of the step. On the emulated reel noise
and scatter add up to 0.9 % to that of a record."""


class Row(NamedTuple):
    """Row of the before/after table; `tuned` is empty without an improvement."""

    label: str
    start: str
    tuned: str


def heading(result: RunResult) -> str:
    """The run in one line, its ending first."""
    if result.ending is RunEnding.TUNED:
        start, cost = result.verdict.start_cost, result.verdict.cost
        change = f"cost {start:.3g} → {cost:.3g}, {result.improvement}, {_robustness(result)}"
    elif result.improvement is not None:
        change = f"cost {result.improvement}, keep the initial gains"
    else:
        change = "keep the initial gains"
    return f"{result.ending.upper()}: {result.rig.name}, {len(result.entries)} trials, {change}"


def rows(result: RunResult) -> tuple[Row, ...]:
    """The before/after table as text; the last column is empty without an improvement."""
    start = result.start.cells()
    tuned = result.tuned.cells() if result.tuned else dict.fromkeys(start, "")
    rows = [Row(label, start[label], tuned.get(label, "-")) for label in start]
    shown = robustness_cells(result.claim.margins)
    rows += [Row(label, *(("-", x) if result.tuned else (x, ""))) for label, x in shown]
    return tuple(rows)


def remarks(result: RunResult) -> tuple[str, ...]:
    """The conclusion and the warnings, a sentence each."""
    counts = ((result.unsafe, "unsafe"), (result.verdict.declined, "declined and not run"))
    sentences = (
        result.message,
        *_start_remarks(result),
        *(f"{n} trial{'s were' if n > 1 else ' was'} {what}" for n, what in counts if n),
        *(finding.sentence for finding in result.findings),
        *(_robustness_remarks(result) if result.verdict.complete else ()),
    )
    return tuple(f"{sentence[:1].upper()}{sentence[1:]}." for sentence in sentences)


def _start_remarks(result: RunResult) -> Iterator[str]:
    """Origin of initial gains that are not the rig's, and gains that were not tuned."""
    if result.plan.start_source:
        source = result.plan.start_source
        yield f"the search began at {source}, which are not live on the rig yet"
    space = result.plan.tuner.space
    left = left_out(result.start_gains, space.names, result.plan.cost.settling_time_s)
    if left and space.form == "parallel":
        yield left


def _robustness(result: RunResult) -> str:
    """The claims about the tuned gains, in a few words."""
    margins = result.claim.margins
    if margins is None:
        return "no margins claimed"
    return f"Ms {margins.sensitivity.value:.2f}"


def _robustness_remarks(result: RunResult) -> tuple[str, ...]:
    """Properties that the records do not show, and the cost of the limits."""
    loop, limits, tuned = result.identified, result.plan.limits, result.tuned
    remarks = [*loop.remarks]
    reason = result.claim.reason
    if result.ending is RunEnding.NOT_ROBUST:  # few trials were near the initial gains
        beyond = loop.fit is not None and loop.fit.misfit > MISFIT_MAX
        reason = unexplained(loop.fit.misfit) if loop.fit and beyond else ""
    if reason:
        remarks.append(f"no sensitivity is claimed from the records: {reason}")
    kept = None if limits is None else limits.max_overshoot
    measured = math.nan
    if result.claim.margins is not None:
        measured = result.claim.margins.overshoot.value
    elif tuned is not None and tuned.metrics is not None:
        measured = tuned.metrics.overshoot
    if tuned is not None and kept is not None and measured > kept + OVERSHOOT_ALLOWED:
        whose = (
            "" if result.plan.uses_records else f", which {result.plan.tuner.name} does not keep"
        )
        remarks.append(f"the overshoot of {measured:.1%} exceeds the limit of {kept:.1%}{whose}")
    price = limit_price(loop, result.claim, result.plan, result.rig, result.gains)
    if tuned is not None and price is not None:
        remarks.append(price.sentence)
    first, start_cost = result.first_record, result.verdict.start_cost
    return (*remarks, *quality_remarks(result.plan, result.rig, first, start_cost, loop.fit))
