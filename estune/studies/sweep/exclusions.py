"""The tunings that a law excludes, counted by their reasons, with what to change."""

import math
from collections import Counter
from collections.abc import Sequence
from operator import attrgetter

from estune.studies.sweep.outcome import CONVERGED_BELOW, CellOutcome
from estune.support.lazy_sequence import LazySequence
from estune.tuners import DEFAULT_TUNER

_MESSAGES_MAX = 3
"""Different reasons of failure that are quoted."""


def exclusion_sentences(outcomes: LazySequence[CellOutcome]) -> tuple[str, ...]:
    """A sentence for each reason: how many tunings it excludes, and what to change."""
    failed = outcomes.where(attrgetter("failed"))
    unsafe = outcomes.where(lambda o: not o.failed and not o.safe)
    unfinished = outcomes.where(lambda o: o.safe and not o.converged)
    total = len(outcomes)
    sentences = []
    if failed:
        remedy = "fix the cause, then run the sweep again: it repeats them"
        sentences.append(f"{_count(failed, total)} failed ({_messages(failed)}): {remedy}")
    if unsafe:
        remedy = "give gentler initial gains (start) or raise eta_max"
        sentences.append(
            f"{_count(unsafe, total)} had unsafe initial gains, such as {unsafe[0].cell.label} "
            f"({unsafe[0].message}): {remedy}"
        )
    known = unfinished.where(lambda o: math.isfinite(o.remaining))
    unknown = unfinished.where(lambda o: not math.isfinite(o.remaining))
    if known:
        sentences.append(f"{_count(known, total)} had {_remaining(known)}: {_more_trials(known)}")
    if unknown:
        what = "ended without an estimate of the remaining improvement"
        sentences.append(f"{_count(unknown, total)} {what}: {_more_trials(unknown)}")
    return tuple(sentences)


def _count(some: Sequence[CellOutcome], total: int) -> str:
    return f"{len(some)} of {total} tuning{'s' if total > 1 else ''}"


def _messages(failed: Sequence[CellOutcome]) -> str:
    counts = Counter(outcome.message for outcome in failed)
    quoted = [
        f"{count} times {message}" if len(counts) > 1 else message
        for message, count in counts.most_common(_MESSAGES_MAX)
    ]
    others = len(counts) - len(quoted)
    return "; ".join(quoted) + (f"; {others} other reasons" if others else "")


def _remaining(unfinished: Sequence[CellOutcome]) -> str:
    least = min(outcome.remaining for outcome in unfinished)
    most = max(outcome.remaining for outcome in unfinished)
    low, high = f"{100.0 * least:.2g}", f"{100.0 * most:.2g}"
    share = f"{low} to {high} %" if low != high else f"{low} %"
    return f"{share} remaining improvement (limit {100.0 * CONVERGED_BELOW:g} %)"


def _more_trials(unfinished: Sequence[CellOutcome]) -> str:
    """More trials than they had, or the default tuner where another was used."""
    trials = max(int(outcome.cell.search["trials"]) for outcome in unfinished)
    remedy = f"give them more trials (trials = {2 * trials} instead of {trials})"
    others = {outcome.cell.tuner for outcome in unfinished} - {DEFAULT_TUNER}
    return f'{remedy}, or tuners = ["{DEFAULT_TUNER}"]' if others else remedy
