"""From the fits of a search to a verdict, with a sentence on each candidate."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import (
    Candidate,
    ModelSummary,
    NamedEffect,
    SearchStep,
    Slugs,
    Verdict,
    explained_share,
    family_of,
)
from plants.diagnosis.search.decide import Decision, decide, probabilities, summed
from plants.diagnosis.search.fitted_models import FittedModels
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.diagnosis.search.screening import Screening
from plants.effects import Effect
from plants.effects.plant_scale import si


class Conclusion(NamedTuple):
    """A verdict and what it rests on.

    Attributes:
        stages: The base model, then the models believed with one effect more each; the base model
            alone for `unknown` and `none`.
        tied: Slugs the records do not distinguish, best first; empty unless `ambiguous`.
        apart: How far the predictions of the first two of these differ, rms in noise floors; nan
            where they are not tied.
        like: What an unexplained error looks like, in words, or empty.
        rest: What the error left looks like, in words, or empty.
        reason: Why a leading model is not believed, or empty.
        probability: Of an effect's family being there, by slug.
        own_probability: Of the effect itself, by slug.
        models: Every model that was fitted, the base model first.
        leading: Slugs of the best named model, whether it is believed or not.
    """

    verdict: Verdict
    stages: tuple[CandidateFit, ...]
    tied: tuple[str, ...] = ()
    apart: float = math.nan
    like: str = ""
    rest: str = ""
    reason: str = ""
    probability: Mapping[str, float] = {}
    own_probability: Mapping[str, float] = {}
    models: tuple[ModelSummary, ...] = ()
    leading: Slugs = frozenset()

    def unknown(self, reason: str) -> "Conclusion":
        """The same fits, none of which is believed."""
        base = self.stages[:1]
        return self._replace(verdict="unknown", stages=base, tied=(), rest="", reason=reason)


def conclude(fitter: ModelFitter, models: FittedModels) -> Conclusion:
    """The verdict on some fits."""
    base, *others = models.judged(fitter)
    decision = decide(base, others)
    p = probabilities(base, others)
    families = summed((m.families, p[m.names]) for m in others)
    effects = summed((m.names, p[m.names]) for m in others)
    # Where no name is believed, the best of the declared effects seldom is there.
    shares = (explained_share(base.J, m.J) for m in others if m.named)
    scale = 1.0 if decision.best else (1.0 - CONSTANTS.named_share) * max(shares, default=0.0)
    fitted = {e.name: e for fit in models.with_effects.values() for e in fit.effects}
    conclusion = Conclusion(
        decision.verdict,
        (models.base,),
        probability={name: scale * families[family_of(e)] for name, e in fitted.items()},
        own_probability={name: scale * effects[name] for name in fitted},
        models=(base, *others),
        leading=decision.leading,
    )
    if not decision.best:
        return conclusion._replace(
            like=_title(models, decision.like), reason=_reason(models, decision, base, others)
        )
    rivals = (decision.best, *decision.tied)
    common = frozenset.intersection(*rivals)
    names = dict.fromkeys(n for slugs in rivals for n in sorted(slugs - common))
    singles = [fit for fit in models.singles if fit.names < decision.best]
    return conclusion._replace(
        stages=(models.base, *singles[:1], models.with_effects[decision.best]),
        tied=tuple(names),
        apart=apart_of(*(models.with_effects[slugs] for slugs in rivals[:2])),
        rest=_rest(models, decision, others),
    )


def apart_of(first: CandidateFit, second: CandidateFit | None = None) -> float:
    """Root mean square of what two fits predict otherwise, in noise floors; nan of one alone."""
    if second is None or not np.array_equal(first.fitted.entries, second.fitted.entries):
        return math.nan
    difference = first.fitted.residuals - second.fitted.residuals
    return float(np.sqrt(np.mean(difference**2)))


def _reason(
    models: FittedModels, decision: Decision, base: ModelSummary, others: Sequence[ModelSummary]
) -> str:
    if not decision.leading:
        return ""
    leading = next(m for m in others if m.names == decision.leading)
    titles = " and ".join(_title(models, name) for name in sorted(decision.leading))
    explained = _percent(explained_share(base.J, leading.J))
    share = f"The best of them, {titles}, explains {explained} of it"
    if leading.eligible:
        return f"{share}."
    return f"{share}, with a parameter at a bound or a size that is too small to matter."


def _rest(models: FittedModels, decision: Decision, others: Sequence[ModelSummary]) -> str:
    """The nameless law that takes the most off what a believed model leaves, if it is much."""
    best = next(m for m in others if m.names == decision.best)
    laws = [m for m in others if not m.named and best.power > CONSTANTS.floor]
    laws = [m for m in laws if m.power - 1.0 < CONSTANTS.one_more * (best.power - 1.0)]
    law = min(laws, key=lambda m: m.power, default=None)
    nameless = [e.name for e in NAMELESS if law is not None and e.name in law.names]
    return _title(models, nameless[0]) if nameless else ""


def _title(models: FittedModels, slug: str) -> str:
    effects = (e for fit in models.with_effects.values() for e in fit.effects)
    return next((e.title for e in effects if e.name == slug), "")


def candidates(
    screening: Screening, models: FittedModels, conclusion: Conclusion
) -> tuple[Candidate, ...]:
    """All effects screened as the first one, best first, each with why it was taken or not."""
    fitted = {fit.effects[0].name: fit for fit in models.singles}
    believed = [e.name for e in conclusion.stages[-1].effects]
    listed = []
    for name, screened in screening.declared.items():
        fit, share, ratio = fitted.get(name), math.nan, math.nan
        if fit is None:
            why = (
                f"{screened.effect.title} changes the predictions in another way: its direction "
                f"explains {_percent(screened.screening_R2)} of the residual"
            )
        else:
            share, ratio = explained_share(models.base.J, fit.J), math.sqrt(fit.J)
            why = _why(fit, share, conclusion)
        family, effect = (
            p.get(name, 0.0) for p in (conclusion.probability, conclusion.own_probability)
        )
        listed.append(Candidate(name, share, ratio, screened.screening_R2, why, family, effect))
    listed.sort(key=lambda c: (c.gap if math.isfinite(c.gap) else math.inf, -c.cosine2))
    listed.sort(key=lambda c: believed.index(c.name) if c.name in believed else len(believed))
    return tuple(listed)


def _why(fit: CandidateFit, share: float, conclusion: Conclusion) -> str:
    best = conclusion.stages[-1].effects
    effect = fit.effects[0]
    what = f"{effect.title} explains {_percent(max(share, 0.0))} of the error power"
    if effect in best:
        return what
    if not best and conclusion.like:
        return f"{what}, but {conclusion.like} explains more"
    if not best:
        return f"{what}, which is too little"
    if family_of(effect) in map(family_of, best):
        return f"{what}; of its family, {best[0].title} is the simplest law that is sufficient"
    return f"{what}; {best[0].title} explains more"


def not_excited(screening: Screening, named: Sequence[type[Effect]]) -> dict[str, str]:
    """Effects that these records cannot show, with the reason; those that are named they show."""
    return {
        name: f"at its usual size {screened.effect.title} would change these records by "
        f"{screened.usual_change:.1g} of the noise floor"
        for name, screened in screening.declared.items()
        if screened.usual_change < CONSTANTS.shown and screened.effect not in named
    }


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def verdict_sentence(
    verdict: Verdict,
    conclusion: Conclusion,
    effects: Sequence[NamedEffect],
    steps: Sequence[SearchStep],
    unit: str,
) -> str:
    """The verdict in plain words; the unit is that of the error."""
    before, after = steps[0], steps[-1]
    error = f"{si(before.gap, unit)}, {before.ratio:.2g} times the noise floor"
    if verdict == "none":
        return f"These records show no missing effect: the prediction error is {error}."
    if verdict == "unknown":
        like = f"It looks like {conclusion.like}." if conclusion.like else ""
        unexplained = f"No declared effect explains the prediction error, {error}."
        return " ".join(filter(None, (unexplained, conclusion.reason, like)))
    titles = " and ".join(effect.title for effect in effects)
    falls = f"the prediction error falls from {error}, to {after.ratio:.2g} times the noise floor"
    if verdict == "ambiguous":
        tied = " from ".join(conclusion.tied)
        alike = ""
        if math.isfinite(conclusion.apart):
            alike = (
                f", whose predictions of them differ by {conclusion.apart:.2g} times the noise "
                "floor"
            )
        return f"These records do not distinguish {tied}{alike}; with {titles} {falls}."
    sentences = " ".join(effect.sentence for effect in effects)
    if verdict == "incomplete":
        remainder = (
            f" The remaining error looks like {conclusion.rest}." if conclusion.rest else ""
        )
        return f"{sentences} With {titles} {falls}: another effect is missing.{remainder}"
    return f"{sentences} With it {falls}."
