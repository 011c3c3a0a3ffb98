"""From what the search found to a verdict, and to sentences on what was ruled out and why."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from plants.diagnosis.result import Candidate, NamedEffect, SearchStep, Verdict
from plants.diagnosis.search import thresholds
from plants.diagnosis.search.model_comparison import explained_fraction, z_score
from plants.diagnosis.search.model_fitter import CandidateFit
from plants.diagnosis.search.stepwise import SearchResult
from plants.effects import Effect


class Conclusion(NamedTuple):
    """A verdict and what it rests on.

    Attributes:
        verdict: The verdict.
        best: The model that is believed: the base model for `unknown` and `none`.
        tied: Slugs the records cannot tell apart, best first; empty unless `ambiguous`.
        like: What no effect is declared of but the gap looks like; empty unless `unknown`.
    """

    verdict: Verdict
    best: CandidateFit
    tied: tuple[str, ...] = ()
    like: str = ""


def conclude(found: SearchResult) -> Conclusion:
    """The verdict on what the search found, on the rank split.

    A name needs that most of the power above the floor is closed, or that what is left is the
    floor.
    """
    before, best = found.base, found.best
    gap_after = math.sqrt(best.rank_J)
    if not best.effects:
        # What only one of the splits shows may be chance.
        nothing = math.sqrt(min(before.rank_J, before.fit_J)) <= thresholds.NOTHING
        like = next((title for one in found.rounds for title in one.rivals.values()), "")
        return Conclusion("none", before) if nothing else Conclusion("unknown", before, like=like)
    closed = explained_fraction(before.rank_J, best.rank_J)
    least = thresholds.CLOSURE if gap_after <= thresholds.GAP else thresholds.CLOSURE_OF_MUCH
    if closed < least and gap_after > thresholds.CLOSED:
        return Conclusion("unknown", before)
    if len(best.effects) == 1 and found.rounds[0].tied:
        return Conclusion("ambiguous", best, (best.effects[0].name, *found.rounds[0].tied))
    return Conclusion("incomplete" if gap_after > thresholds.INCOMPLETE else "named", best)


def candidates(found: SearchResult) -> tuple[Candidate, ...]:
    """All effects tried as the first one, best first, each with why it was taken or ruled out."""
    if not found.rounds:
        return ()
    first = found.rounds[0]
    before, taken = first.before, first.taken
    listed = []
    for a in first.attempts:
        effect = a.effects[-1]
        closed = explained_fraction(before.rank_J, a.rank_J)
        listed.append(
            Candidate(
                effect.name,
                closed,
                math.sqrt(a.rank_J),
                found.screened[effect.name].screening_R2,
                _why(effect, a, before, taken, first.rivals.get(effect.name)),
            )
        )
    fitted = {a.effects[-1].name for a in first.attempts}
    rest = sorted((n for n in first.screened if n not in fitted), key=lambda n: -first.screened[n])
    listed += [
        Candidate(
            name,
            math.nan,
            math.nan,
            first.screened[name],
            f"{found.screened[name].effect.title} would change the predictions in another way: "
            f"its direction explains {_percent(first.screened[name])} of the residual",
        )
        for name in rest
    ]
    if taken is not before:
        listed.sort(key=lambda c: c.name != taken.effects[-1].name)
    return tuple(listed)


def _why(
    effect: type[Effect],
    attempt: CandidateFit,
    before: CandidateFit,
    taken: CandidateFit,
    rival: str | None,
) -> str:
    closed = _percent(max(explained_fraction(before.rank_J, attempt.rank_J), 0.0))
    what = f"{effect.title} closes {closed} of the gap on records it was not fitted to"
    if attempt is taken:
        return what
    if rival is not None:
        return f"{what}, but {rival} closes more"
    if taken is before:
        return f"{what}, too little for a name"
    if z_score(attempt, taken) > 0.0:
        return f"{what}, no more than {taken.effects[-1].title}, which is simpler, needs to"
    reached = _percent(explained_fraction(before.rank_J, taken.rank_J))
    return f"{what}, {taken.effects[-1].title} closes {reached}"


def ruled_out(
    listed: Sequence[Candidate], named: Sequence[str], tied: Sequence[str]
) -> tuple[str, ...]:
    """One sentence for each candidate that is not in the verdict."""
    return tuple(f"{c.sentence}." for c in listed if c.name not in named and c.name not in tied)


def not_excited(found: SearchResult, reasons: Mapping[str, str]) -> dict[str, str]:
    """Effects that these records cannot show, with the reason.

    Args:
        found: The search.
        reasons: What is known of why, by slug.
    """
    return {
        name: reasons.get(
            name,
            f"at its usual size {one.effect.title} would change these records by "
            f"{one.usual_change:.1g} of the floor",
        )
        for name, one in found.screened.items()
        if one.usual_change < thresholds.SHOWN and one.effect not in found.best.effects
    }


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def verdict_sentence(
    verdict: Verdict,
    judged: Conclusion,
    named: Sequence[NamedEffect],
    steps: Sequence[SearchStep],
    unit: str,
) -> str:
    """The verdict in plain words; the unit is that of the gap."""
    before, after = steps[0], steps[-1]
    gap = f"{f'{before.gap:.2g} {unit}'.rstrip()}, {before.ratio:.2g} times the floor"
    if verdict == "none":
        return f"Nothing is missing that these records can show: the gap is {gap}."
    if verdict == "unknown":
        said = f"Something is missing that no declared effect explains: the gap is {gap}."
        return f"{said} It looks like {judged.like}." if judged.like else said
    what = " and ".join(one.title for one in named)
    left = f"the gap falls from {gap}, to {after.ratio:.2g} times the floor"
    if verdict == "ambiguous":
        return f"These records cannot tell {' or '.join(judged.tied)} apart; with {what} {left}."
    sentences = " ".join(one.sentence for one in named)
    if verdict == "incomplete":
        return f"{sentences} With {what} {left}: something more is missing."
    return f"{sentences} With it {left}."
