"""A conclusion: what is believed, how probable each effect is, and the sentences on it."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from plants.diagnosis.result import ModelSummary, SearchStep
from plants.diagnosis.search.conclusion import (
    Conclusion,
    apart_of,
    candidates,
    conclude,
    not_excited,
    verdict_sentence,
)
from plants.diagnosis.search.decide import probabilities
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.effects import EFFECTS

LAWS = EFFECTS | {law.name: law for law in NAMELESS}
NOTHING = frozenset[str]()
GRAVITY, COULOMB, DAHL = "link_gravity", "coulomb_friction", "dahl_hysteresis"


def fit(names, J, values=1, **fields):
    effects = tuple(LAWS[name] for name in names)
    families = frozenset(effect.family or effect.name for effect in effects)
    return ModelSummary(frozenset(names), families, values, J, values, **fields)


def law(name, J, values=3):
    return fit([name], J, values, named=False)


def concluded(J, *others):
    """The conclusion on fits, each of whose residuals are its power, and their number."""
    base = SimpleNamespace(effects=(), names=NOTHING, J=J)
    fits = {
        m.names: SimpleNamespace(
            effects=[LAWS[name] for name in sorted(m.names)],
            names=m.names,
            J=m.J,
            fitted=SimpleNamespace(entries=np.arange(4), residuals=np.full(4, m.J)),
        )
        for m in others
    }
    singles = sorted((one for one in fits.values() if len(one.names) == 1), key=lambda f: f.J)
    summary = ModelSummary(NOTHING, NOTHING, 0, J, 0)
    models = SimpleNamespace(
        judged=lambda _: [summary, *others], base=base, singles=singles, with_effects=fits
    )
    return conclude(None, models), probabilities(summary, others), models


def test_effects_are_as_probable_as_models_with_them_and_less_where_no_name_is_believed():
    """0.15 of the share that the best name explains, which a nameless law does not count for."""
    rivals = [
        fit([COULOMB], 10.5),
        fit([DAHL], 13.0),
        fit([GRAVITY], 15.0),
        law("cable_bend", 8.0),
    ]
    named = [fit([COULOMB], 1.1), fit([DAHL], 13.0), fit([GRAVITY], 15.0), law("cable_bend", 8.0)]
    for others, verdict, scale in ((rivals, "unknown", 0.15 * 9.5 / 19.0), (named, "named", 1.0)):
        conclusion, p, _ = concluded(20.0, *others)
        assert conclusion.verdict == verdict
        own = {one: scale * p[frozenset([one])] for one in (COULOMB, DAHL, GRAVITY)}
        friction = own[COULOMB] + own[DAHL]
        found, families = conclusion.own_probability, conclusion.probability
        assert {one: found[one] for one in own} == pytest.approx(own)
        assert [families[one] for one in (COULOMB, DAHL)] == pytest.approx([friction] * 2)
        assert families[GRAVITY] == pytest.approx(own[GRAVITY])
        assert bool(conclusion.reason) is (verdict == "unknown")
    conclusion, *_ = concluded(20.0, law("cable_bend", 1.1))
    assert (conclusion.verdict, conclusion.reason) == ("unknown", "")
    assert conclusion.like == LAWS["cable_bend"].title


def test_rivals_are_told_without_what_they_share_and_by_how_much_they_differ():
    singles = [fit([GRAVITY], 30.0), fit(["backlash"], 20.0, eligible=False)]
    pairs = [fit([GRAVITY, COULOMB], 1.0, 2), fit([GRAVITY, DAHL], 1.02, 2)]
    conclusion, _, models = concluded(2000.0, *singles, *pairs)
    assert conclusion.verdict == "ambiguous"
    assert conclusion.tied == (COULOMB, DAHL)
    assert conclusion.apart == pytest.approx(0.02)
    stages = [NOTHING, singles[0].names, pairs[0].names]
    assert [stage.names for stage in conclusion.stages] == stages
    conclusion, *_ = concluded(2000.0, *singles, pairs[0])
    assert (conclusion.verdict, conclusion.tied) == ("named", ())
    assert math.isnan(conclusion.apart)
    first, second = (models.with_effects[pair.names] for pair in pairs)
    other = SimpleNamespace(fitted=SimpleNamespace(entries=np.arange(1, 5), residuals=np.ones(4)))
    assert math.isnan(apart_of(first, other))
    assert apart_of(second, first) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("best", "left", "told"),
    [(20.0, 12.2, True), (20.0, 12.6, False), (1.25, 1.0, False), (1.35, 1.12, True)],
)
def test_rest_is_that_of_a_law_that_takes_four_tenths_off_what_is_left_above_the_noise(
    best, left, told
):
    """A name that leaves less yet is no such law."""
    others = [
        fit([COULOMB], 1000.0),
        fit([GRAVITY], best),
        law("cable_bend", left),
        fit([GRAVITY, DAHL], 1.0, 9, eligible=False),
    ]
    conclusion, *_ = concluded(8000.0, *others)
    assert conclusion.verdict in {"named", "incomplete"}
    assert conclusion.rest == (LAWS["cable_bend"].title if told else "")


SCREENED = {
    name: SimpleNamespace(effect=EFFECTS[name], screening_R2=R2, usual_change=change)
    for name, R2, change in (
        (DAHL, 0.5, 1.0),
        ("backlash", 0.95, 0.29),
        (COULOMB, 0.6, 0.1),
        ("cogging", 0.97, 0.31),
    )
}


def listed(believed=(), like=""):
    """Candidates of two frictions and a backlash that were fitted, and one effect that was not."""
    fits = [fit([COULOMB], 11.0), fit([DAHL], 31.0), fit(["backlash"], 61.0)]
    models = SimpleNamespace(
        singles=[SimpleNamespace(effects=(EFFECTS[next(iter(m.names))],), J=m.J) for m in fits],
        base=SimpleNamespace(J=101.0),
    )
    stages = [
        SimpleNamespace(effects=tuple(EFFECTS[name] for name in believed[:n])) for n in (0, 9)
    ]
    screening = SimpleNamespace(declared=SCREENED)
    return candidates(screening, models, Conclusion("named", tuple(stages), like=like))


@pytest.mark.parametrize("believed", [(), (DAHL,), (DAHL, COULOMB)])
def test_candidates_are_what_is_believed_then_the_best_fits_then_what_was_not_fitted(believed):
    rest = [one for one in (COULOMB, DAHL, "backlash", "cogging") if one not in believed]
    assert [one.name for one in listed(believed)] == [*believed, *rest]


def test_sentence_on_a_candidate_says_why_it_is_not_believed():
    told = {one.name: one.sentence for one in listed((DAHL,), like="a bend")}
    title = EFFECTS[DAHL].title
    assert told[DAHL].endswith("explains 70 % of the error power")
    assert told[COULOMB].endswith(
        f"; of its family, {title} is the simplest law that is sufficient"
    )
    assert told["backlash"].endswith(f"40 % of the error power; {title} explains more")
    assert "explains 97 % of the residual" in told["cogging"]
    for like, words in (("a bend", ", but a bend explains more"), ("", ", which is too little")):
        assert all(one.sentence.endswith(words) for one in listed(like=like)[:3])


def test_effect_that_would_hardly_change_the_records_is_not_shown_by_them_unless_it_is_named():
    screening = SimpleNamespace(declared=SCREENED)
    assert set(not_excited(screening, [])) == {"backlash", COULOMB}
    hidden = not_excited(screening, [EFFECTS[COULOMB]])
    assert set(hidden) == {"backlash"}
    assert "by 0.3 of the noise floor" in hidden["backlash"]


def test_sentence_of_each_verdict_tells_the_error_before_and_after():
    steps = [SearchStep(None, 3e-3, 1e-3, n) for n in (8.0, 4.0, 2.0)]
    named = [SimpleNamespace(title=f"effect {n}", sentence=f"It has {n}.") for n in (1, 2)]
    before, fall = "8 times the noise floor", "to 2 times the noise floor"

    def said(verdict, **fields):
        return verdict_sentence(verdict, Conclusion(verdict, (), **fields), named, steps, "rad")

    assert said("none").startswith("These records show no missing effect")
    assert said("none").endswith(f"{before}.")
    unknown = said("unknown", reason="Because.", like="a bend")
    assert unknown.endswith(f"{before}. Because. It looks like a bend.")
    assert said("unknown").endswith(f"{before}.")
    for verdict in ("named", "incomplete", "ambiguous"):
        text = said(verdict, tied=("a", "b"))
        assert before in text
        assert fall in text
        assert ("effect 1 and effect 2" in text) is (verdict != "named")
        assert ("do not distinguish a from b; with" in text) is (verdict == "ambiguous")
        assert ("It has 1. It has 2." in text) is (verdict != "ambiguous")
        assert text.endswith("another effect is missing.") is (verdict == "incomplete")
    assert said("incomplete", rest="a bend").endswith("remaining error looks like a bend.")
    assert "differ by 0.2 times" in said("ambiguous", tied=("a", "b"), apart=0.2)
