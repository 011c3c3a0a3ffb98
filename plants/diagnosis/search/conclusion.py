"""From the fits of a search to a verdict, with a sentence on each candidate."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from plants.diagnosis.result import (
    Candidate,
    ModelSummary,
    NamedEffect,
    SearchStep,
    Slugs,
    Verdict,
)
from plants.diagnosis.search.constants import CONSTANTS
from plants.diagnosis.search.decide import (
    Decision,
    decide,
    effect_probabilities,
    explained,
    family_probabilities,
    probabilities,
)
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, family_of
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.diagnosis.search.search import SearchResult, is_named
from plants.effects.plant_scale import si


class Conclusion(NamedTuple):
    """A verdict and what it rests on.

    Attributes:
        verdict: The verdict.
        stages: The base model, then the models believed with one effect more each.
        tied: Slugs the records do not distinguish, best first; empty unless `ambiguous`.
        like: What an unexplained error looks like, in words, or empty.
        rest: What the error left looks like, in words, or empty.
        reason: Why a leading model is not believed, or empty.
        probability: Of an effect's family being there, by slug.
        own_probability: Of the effect itself, by slug.
        models: Every model that was fitted, the base model first.
    """

    verdict: Verdict
    stages: tuple[CandidateFit, ...]
    tied: tuple[str, ...] = ()
    like: str = ""
    rest: str = ""
    reason: str = ""
    probability: Mapping[str, float] = {}
    own_probability: Mapping[str, float] = {}
    models: tuple[ModelSummary, ...] = ()

    @property
    def best(self) -> CandidateFit:
        """The model that is believed: the base model for `unknown` and `none`."""
        return self.stages[-1]


def conclude(fitter: ModelFitter, found: SearchResult) -> Conclusion:
    """The verdict on the fits of a search."""
    base, *models = found.summaries(fitter)
    decision = decide(base, models)
    p = probabilities(base, models)
    families, effects = family_probabilities(models, p), effect_probabilities(models, p)
    # Where no name is believed, the best of the declared effects seldom is there.
    named = (explained(base, m) for m in models if m.named)
    scale = 1.0 if decision.best else (1.0 - CONSTANTS.named_share) * max(named, default=0.0)
    fitted = {e.name: e for one in found.fits.values() for e in one.effects}
    probability = {name: scale * families[family_of(e)] for name, e in fitted.items()}
    own = {name: scale * effects[name] for name in fitted}
    if not decision.best:
        return Conclusion(
            decision.verdict,
            (found.base,),
            like=_title(found, decision.like),
            reason=_reason(found, decision, base, models),
            probability=probability,
            own_probability=own,
            models=(base, *models),
        )
    names = dict.fromkeys(n for slugs in (decision.best, *decision.tied) for n in sorted(slugs))
    return Conclusion(
        decision.verdict,
        _stages(found, decision.best),
        tied=tuple(names) if decision.verdict == "ambiguous" else (),
        rest=_rest(found, decision, models),
        probability=probability,
        own_probability=own,
        models=(base, *models),
    )


def _reason(
    found: SearchResult, decision: Decision, base: ModelSummary, models: Sequence[ModelSummary]
) -> str:
    """A sentence on the share that the best named model explains, where it is not believed."""
    if not decision.leading:
        return ""
    leading = next(m for m in models if m.names == decision.leading)
    titles = " and ".join(_title(found, name) for name in sorted(decision.leading))
    said = f"The best of them, {titles}, explains {_percent(explained(base, leading))} of it"
    return f"{said}." if leading.eligible else f"{said}, but at a bound, or too small to matter."


def _stages(found: SearchResult, slugs: Slugs) -> tuple[CandidateFit, ...]:
    """The base model, the better single one of a pair, and the model believed."""
    single = [frozenset({name}) for name in slugs]
    singles = sorted((found.fits[n] for n in single if n in found.fits), key=lambda f: f.J)
    return (found.base, *singles[: len(slugs) - 1], found.fits[slugs])


def _rest(found: SearchResult, decision: Decision, models: Sequence[ModelSummary]) -> str:
    """The nameless law that takes the most off what a believed model leaves, if it is much."""
    best = next(m for m in models if m.names == decision.best)
    share = 1.0 - CONSTANTS.one_more
    laws = [m for m in models if not m.named and best.power > CONSTANTS.floor]
    laws = [m for m in laws if m.power - 1.0 < (1.0 - share) * (best.power - 1.0)]
    law = min(laws, key=lambda m: m.power, default=None)
    nameless = [e.name for e in NAMELESS if law is not None and e.name in law.names]
    return _title(found, nameless[0]) if nameless else ""


def _title(found: SearchResult, slug: str) -> str:
    """Title of an effect that was fitted."""
    effects = (e for one in found.fits.values() for e in one.effects)
    return next((e.title for e in effects if e.name == slug), "")


def candidates(found: SearchResult, judged: Conclusion) -> tuple[Candidate, ...]:
    """All effects looked at as the first one, best first, each with why it was taken or not."""
    before = ModelSummary(frozenset(), frozenset(), 0, found.base.J, 0)
    fitted = {one.effects[0].name: one for one in found.of(1) if is_named(one)}
    believed = [e.name for e in judged.best.effects]
    listed = []
    for name, s in found.screened.items():
        one = fitted.get(name)
        if one is None:
            part, left, why = math.nan, math.nan, f"{s.effect.title} would change other things: "
            why += f"its direction explains {_percent(s.screening_R2)} of the residual"
        else:
            part = explained(before, before._replace(J=one.J))
            left, why = math.sqrt(one.J), _why(one, part, judged)
        listed.append(
            Candidate(
                name,
                part,
                left,
                s.screening_R2,
                why,
                judged.probability.get(name, 0.0),
                judged.own_probability.get(name, 0.0),
            )
        )
    listed.sort(key=lambda c: (c.gap if math.isfinite(c.gap) else 1e9, -c.cosine2))
    listed.sort(key=lambda c: believed.index(c.name) if c.name in believed else len(believed))
    return tuple(listed)


def _why(one: CandidateFit, part: float, judged: Conclusion) -> str:
    effect, best = one.effects[0], judged.best.effects
    what = f"{effect.title} explains {_percent(max(part, 0.0))} of the error power"
    if effect in best:
        return what
    if not best:
        return f"{what}, but {judged.like} explains more" if judged.like else f"{what}, too little"
    if family_of(effect) in map(family_of, best):
        return f"{what}, no more than {best[0].title}, which is simpler, needs to"
    return f"{what}, {best[0].title} does better"


def not_excited(found: SearchResult) -> dict[str, str]:
    """Effects that these records cannot show, with the reason."""
    return {
        name: f"at its usual size {one.effect.title} would change these records by "
        f"{one.usual_change:.1g} of the noise floor"
        for name, one in found.screened.items()
        if one.usual_change < CONSTANTS.shown
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
    """The verdict in plain words; the unit is that of the error."""
    before, after = steps[0], steps[-1]
    error = f"{si(before.gap, unit)}, {before.ratio:.2g} times the noise floor"
    if verdict == "none":
        return f"Nothing is missing that these records can show: the prediction error is {error}."
    if verdict == "unknown":
        like = f"It looks like {judged.like}." if judged.like else ""
        said = f"No declared effect explains the prediction error, {error}."
        return " ".join(filter(None, (said, judged.reason, like)))
    what = " and ".join(one.title for one in named)
    left = f"the prediction error falls from {error}, to {after.ratio:.2g} times the noise floor"
    if verdict == "ambiguous":
        return f"These records cannot tell {' or '.join(judged.tied)} apart; with {what} {left}."
    sentences = " ".join(one.sentence for one in named)
    if verdict == "incomplete":
        rest = f" What is left looks like {judged.rest}." if judged.rest else ""
        return f"{sentences} With {what} {left}: something more is missing.{rest}"
    return f"{sentences} With it {left}."
