"""Which of the fitted models is believed, and how probable each is."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import ModelSummary as Model
from plants.diagnosis.result import Slugs, Verdict, explained_share


class Decision(NamedTuple):
    """The decision on the model.

    Attributes:
        verdict: `named`, `incomplete`, `ambiguous`, `unknown` or `none`.
        best: Slugs of the model that is believed; empty for `unknown` and `none`.
        tied: Slugs of models that cannot be told from it.
        like: Slug of the nameless law the gap looks like, or empty.
        leading: The best named model whether believed or not.
    """

    verdict: Verdict
    best: Slugs
    tied: tuple[Slugs, ...] = ()
    like: str = ""
    leading: Slugs = frozenset()


def beats(full: Model, simple: Model, share: float, least: float = 0.0) -> bool:
    """Whether a model takes off so much of what a simpler one leaves above the floor."""
    return simple.power > max(CONSTANTS.floor, least) and full.power - 1.0 <= (1.0 - share) * (
        simple.power - 1.0
    )


def decide(base: Model, models: Sequence[Model]) -> Decision:
    """The verdict on the fits of a search."""
    if base.power <= CONSTANTS.nothing:
        return Decision("none", frozenset())
    p = probabilities(base, models)
    base, *models = relative([base, *models])
    named = [m for m in models if m.named and m.eligible]
    best = _supported(best_of(models), models, p)
    nameless = [m for m in models if not m.named and len(m.names) == 1]
    if best is None:
        like = [m for m in nameless if explained_share(base.J, m.J) >= CONSTANTS.named_share]
        names = [next(iter(m.names)) for m in sorted(like, key=lambda m: m.power)]
        leading = min((m for m in models if m.named), key=lambda m: m.power, default=base)
        return Decision("unknown", frozenset(), like=(*names, "")[0], leading=leading.names)
    likelier = sorted((m for m in named if _is_likelier(m, best)), key=lambda m: m.power)
    for other in likelier:
        explained = explained_share(base.J, other.J)
        if not beats(best, other, CONSTANTS.one_more) and explained >= CONSTANTS.named_share:
            best = other
            break
    for law in sorted(nameless, key=lambda m: m.power):
        fewer = law.values < best.values and not beats(best, law, CONSTANTS.one_more)
        as_few = law.values <= best.values and beats(law, best, CONSTANTS.one_more)
        if fewer or as_few or beats(law, best, CONSTANTS.named_share):
            return Decision("unknown", frozenset(), like=next(iter(law.names)), leading=best.names)
    if explained_share(base.J, best.J) < CONSTANTS.named_share and best.power > CONSTANTS.floor:
        return Decision("unknown", frozenset(), leading=best.names)
    tied = _tied(best, named, p)
    verdict: Verdict = "incomplete" if best.power > CONSTANTS.above_noise**2 else "named"
    return Decision("ambiguous" if tied else verdict, best.names, tied, leading=best.names)


def relative(models: Sequence[Model]) -> list[Model]:
    """The models with powers relative to the noise, which is no more than the best one leaves."""
    least = min(1.0, *(m.J for m in models))
    return [m._replace(J=m.J / least) for m in models]


def _tied(best: Model, named: Sequence[Model], p: Mapping[Slugs, float]) -> tuple[Slugs, ...]:
    """Models with no more effects that are about as probable: of other families, or rivals.

    Of laws of a family a fuller one is taken for the share it explains; two with as many values
    are rivals like any others.
    """
    others = [
        m
        for m in named
        if not m.families & best.families
        or (m.families, m.rank, m.values) == (best.families, best.rank, best.values)
    ]
    others = [m for m in others if m.names != best.names]
    # Of two, that whose size a scale tells without the machine is the less likely one.
    others = [m for m in others if len(m.names) <= len(best.names) and not m.known_apart]
    close = [m for m in others if p[m.names] > CONSTANTS.tied * (p[m.names] + p[best.names])]
    return tuple(m.names for m in sorted(close, key=lambda m: m.power))


def _supported(
    best: Model | None, models: Sequence[Model], p: Mapping[Slugs, float]
) -> Model | None:
    """The best model, or of a pair the best without the family that is rather not there.

    Beside a first effect of great power any second one is improbable, for laws are not exact. It
    is there all the same where the first alone is incomplete, and it explains as much of what that
    leaves as any name has to.
    """
    if best is None or len(best.families) < 2:
        return best
    known = summed((m.families, p[m.names]) for m in models)
    doubtful = min(best.families, key=lambda family: known[family])
    if known[doubtful] >= 0.5:
        return best
    others = [m for m in models if doubtful not in m.families]
    first = _supported(best_of(others), others, p)
    if first is None or not first.families < best.families:
        return first
    rest = beats(best, first, CONSTANTS.named_share, CONSTANTS.above_noise**2)
    return best if rest else first


def _is_likelier(model: Model, best: Model) -> bool:
    """Whether a model of other families is the likelier of two that explain as much.

    One whose size a scale tells without the machine is the less likely, however few its values.
    """
    if len(model.names) > len(best.names) or model.families & best.families:
        return False
    if model.known_apart != best.known_apart:
        return best.known_apart
    return model.values < best.values


def best_of(models: Sequence[Model]) -> Model | None:
    """The best single effect, or the best pair where the second takes off so much more."""
    named = [m for m in models if m.named and m.eligible]
    singles = [m for m in named if len(m.names) == 1]
    single = _member(singles)
    pairs = [m for m in named if len(m.names) == 2]
    if single is None or not pairs:
        return _member(pairs) or single
    fullest = min(singles, key=lambda m: m.power)
    if beats(min(pairs, key=lambda m: m.power), fullest, CONSTANTS.one_more, CONSTANTS.nothing):
        return _member(pairs)
    return single


def _member(models: Sequence[Model]) -> Model | None:
    """The best model, or the simplest of its families that a fuller one does not beat."""
    if not models:
        return None
    best = min(models, key=lambda m: m.power)
    alike = sorted((m for m in models if m.families == best.families), key=lambda m: (m.rank, m.J))
    kept = alike[0]
    for fuller in alike[1:]:
        if beats(fuller, kept, CONSTANTS.one_more):
            kept = fuller
    return kept


def probabilities(base: Model, models: Sequence[Model]) -> Mapping[Slugs, float]:
    """Probability of each model: p ~ exp(-L/2), L = n ln(P + f (J0 - 1)) + k ln n.

    Powers are relative to the best one's, as in a decision: with a noise that is overestimated two
    laws of 0.74 and 0.95 would else be alike.
    """
    all_ = relative([base, *models])
    n, slack = CONSTANTS.effective, CONSTANTS.form * (all_[0].power - 1.0)
    L = [n * math.log(m.power + slack) + m.values * math.log(n) for m in all_]
    weight = [math.exp(-0.5 * (cost - min(L))) for cost in L]
    return {m.names: w / sum(weight) for m, w in zip(all_, weight, strict=True)}


def summed(listed: Iterable[tuple[Slugs, float]]) -> dict[str, float]:
    """Probability that each effect, or each family, is there: the sum over models that have it."""
    total: dict[str, float] = defaultdict(float)
    for names, probability in listed:
        for name in names:
            total[name] += probability
    return total
