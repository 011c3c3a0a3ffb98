"""The models that were fitted, and what a decision between them rests on."""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import ModelSummary, Slugs, family_of
from plants.diagnosis.search.decide import beats
from plants.diagnosis.search.intervals import intervals
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.effects import RecordScale


@dataclass(frozen=True, slots=True, eq=False)
class FittedModels:
    """The base model, and the best fit of each set of effects.

    Attributes:
        given: The model as given, with nothing but values of single records fitted.
    """

    given: CandidateFit
    base: CandidateFit
    with_effects: Mapping[Slugs, CandidateFit] = field(default_factory=dict)

    def adding(self, fits: Iterable[CandidateFit]) -> "FittedModels":
        """These, and each further fit that is the best of its effects."""
        best = dict(self.with_effects)
        for fit in fits:
            if fit.names not in best or fit.J < best[fit.names].J:
                best[fit.names] = fit
        return replace(self, with_effects=best)

    @property
    def singles(self) -> list[CandidateFit]:
        """The fits with one effect, the best first."""
        fits = (fit for fit in self.with_effects.values() if len(fit.effects) == 1)
        return sorted(fits, key=lambda fit: fit.J)

    def summaries(self, scale: RecordScale) -> list[ModelSummary]:
        """Every model by what a decision rests on, the base model first."""
        return [summarise(fit, scale) for fit in (self.base, *self.with_effects.values())]

    def judged(self, fitter: ModelFitter) -> list[ModelSummary]:
        """The summaries; a model is eligible only where each effect's interval excludes nothing.

        Intervals are worked out of those pairs that beat every single effect in them, and of the
        single effects that leave the least until one of them is shown.
        """
        summaries = self.summaries(fitter.scale)
        singles = {s.names: s for s in summaries if len(s.names) == 1}

        def is_in_question(pair: ModelSummary) -> bool:
            rivals = [singles.get(frozenset({name})) for name in pair.names]
            return (
                len(pair.names) == 2
                and pair.named
                and pair.eligible
                and all(r is None or beats(pair, r, CONSTANTS.one_more) for r in rivals)
            )

        def is_shown(model: ModelSummary) -> bool:
            return has_evidence(fitter, self.with_effects[model.names], self.base)

        leading = sorted(
            (s for s in singles.values() if s.named and s.eligible), key=lambda s: s.J
        )
        unshown = {s.names for s in itertools.takewhile(lambda s: not is_shown(s), leading)}
        return [
            s._replace(eligible=is_shown(s))
            if is_in_question(s)
            else s._replace(eligible=s.eligible and s.names not in unshown)
            for s in summaries
        ]


def summarise(fit: CandidateFit, scale: RecordScale) -> ModelSummary:
    """The properties of a fit that a decision rests on."""
    values, rank = fit.values, sum(len(e.parameters()) for e in fit.effects)
    return ModelSummary(
        names=fit.names,
        families=frozenset(map(family_of, fit.effects)),
        rank=rank,
        J=fit.J,
        # A law without a name may stand for another where a value of it is at a bound.
        values=fit.own_values if is_named(fit) else rank,
        eligible=all(
            e.matters({n: values[f"{e.name}.{n}"] for n in e.parameters()}, scale)
            and not fit.at_bound(e)
            for e in fit.effects
        ),
        named=is_named(fit),
        known_apart=any(e.known_apart for e in fit.effects),
    )


def is_named(fit: CandidateFit) -> bool:
    """Whether a model has no law without a name."""
    return not any(e in NAMELESS for e in fit.effects)


def has_evidence(fitter: ModelFitter, fit: CandidateFit, base: CandidateFit) -> bool:
    """Whether intervals of each effect's sizes exclude the values at which it does nothing."""
    stated = intervals(fitter, fit, base)
    free = fit.fitted.predictor.free
    for effect in fit.effects:
        sizes = [f for f in free if f.owner == effect.name and f.neutral is not None]
        if all(stated[f.name].low <= (f.neutral or 0.0) <= stated[f.name].high for f in sizes):
            return False
    return True
