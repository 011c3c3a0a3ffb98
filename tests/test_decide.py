"""Decision between fitted models: shares of power, families, nameless laws, probabilities."""

import math
from random import Random
from types import SimpleNamespace

import numpy as np
import pytest

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import ModelSummary, SearchStep
from plants.diagnosis.search.conclusion import (
    Conclusion,
    _rest,
    apart_of,
    candidates,
    conclude,
    verdict_sentence,
)
from plants.diagnosis.search.decide import Decision, decide, probabilities, summed
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.effects import EFFECTS
from tests.support_decision import NOTHING, decided, odds, random_fits


def base(J):
    return ModelSummary(NOTHING, NOTHING, 0, J, 0)


def model(names, J, values=1, *, rank=None, family="", **fields):
    slugs = frozenset(names.split("+"))
    families = frozenset({family}) if family else slugs
    return ModelSummary(slugs, families, values if rank is None else rank, J, values, **fields)


def test_decision_and_probabilities_are_those_of_the_rules_written_out_anew():
    random, verdicts = Random(1), set()  # noqa: S311  no secret
    for _ in range(400):
        before, fits = random_fits(random)
        decision = decided(before, fits)
        assert decide(before, fits) == decision
        p = probabilities(before, fits)
        assert max(abs(p[names] - q) for names, q in odds(before, fits).items()) < 1e-9
        verdicts.add(decision.verdict)
    assert verdicts == {"none", "named", "incomplete", "ambiguous", "unknown"}


def test_probabilities_of_models_that_leave_an_enormous_power_sum_to_one():
    p = probabilities(base(1e30), [model("a", 1e28), model("b", 1e29)])
    assert sum(p.values()) == pytest.approx(1.0)


def test_error_at_the_noise_floor_gives_none_whatever_fits_better():
    assert decide(base(1.2), [model("a", 0.9)]).verdict == "none"


def test_effect_that_explains_nearly_all_is_named():
    decision = decide(base(20.0), [model("a", 1.1), model("b", 15.0)])
    assert (decision.verdict, decision.best) == ("named", {"a"})


def test_effect_that_leaves_much_is_incomplete():
    assert decide(base(2000.0), [model("a", 100.0)]).verdict == "incomplete"


@pytest.mark.parametrize(("noises", "verdict"), [(2.5, "named"), (3.5, "incomplete")])
def test_effect_is_incomplete_where_it_leaves_three_times_the_noise(noises, verdict):
    assert decide(base(2000.0), [model("a", noises**2)]).verdict == verdict


def test_effect_that_explains_half_is_not_named():
    decision = decide(base(20.0), [model("a", 10.0)])
    assert (decision.verdict, decision.leading) == ("unknown", {"a"})


@pytest.mark.parametrize(("J", "best"), [(95.0, "simple"), (20.0, "full")])
def test_fuller_member_of_a_family_needs_a_large_share_of_what_the_simpler_leaves(J, best):
    simple = model("simple", 100.0, 1, family="friction")
    full = model("full", J, 3, family="friction")
    assert decide(base(2000.0), [simple, full]).best == {best}


@pytest.mark.parametrize(("J", "best"), [(1.0, "simple"), (0.7, "full")])
def test_model_that_leaves_less_than_the_noise_shows_that_the_noise_is_smaller(J, best):
    simple = model("simple", 1.2, 1, family="friction")
    full = model("full", J, 3, family="friction")
    assert decide(base(20.0), [simple, full]).best == {best}


def test_member_too_small_to_matter_is_not_named():
    simple = model("simple", 30.0, 1, family="friction")
    full = model("full", 2.0, 3, family="friction", eligible=False)
    assert decide(base(2000.0), [simple, full]).best == {"simple"}


def test_effect_that_may_not_be_named_leads_where_no_other_explains_the_error():
    worse = model("b", 9.0, eligible=False)
    decision = decide(base(20.0), [worse, model("a", 1.1, eligible=False)])
    assert (decision.verdict, decision.best, decision.leading) == ("unknown", NOTHING, {"a"})


@pytest.mark.parametrize(("J", "best"), [(9.0, "a"), (2.0, "a+b")])
def test_second_effect_needs_a_large_share_of_what_the_first_leaves(J, best):
    models = [model("a", 10.0), model("a+b", J, 2)]
    assert decide(base(200.0), models).best == frozenset(best.split("+"))


@pytest.mark.parametrize(("J", "best"), [(1.5, {"a"}), (1.7, {"a", "b"})])
def test_second_effect_is_looked_for_only_where_the_first_leaves_that_something_is_missing(
    J, best
):
    assert decide(base(20.0), [model("a", J), model("a+b", 1.0, 2)]).best == best


@pytest.mark.parametrize(("values", "best"), [(2, {"a", "b"}), (5, {"a"})])
def test_second_effect_is_named_only_if_it_is_rather_there_than_not(values, best):
    pair = model("a+b", 7.0, values)
    assert decide(base(2000.0), [model("a", 30.0), pair]).best == best


def test_second_effect_beside_a_far_greater_one_is_named_where_it_explains_the_rest():
    """Gravity of 1.9 N m and friction of 0.12 N m, of which 5 % of gravity would be enough."""
    singles = [model("gravity", 34.0, 2), model("friction", 8300.0)]
    for left, best in ((1.4, {"gravity", "friction"}), (9.0, {"gravity"})):
        pair = model("gravity+friction", left, 3)
        rival = model("gravity+bend", 20.0, 3)
        assert decide(base(8450.0), [*singles, pair, rival]).best == best
    useless = [model("gravity", 34.0, 2, eligible=False), model("friction", 8300.0)]
    assert not decide(base(8450.0), [*useless, model("gravity+bend", 1.4, 30)]).best


@pytest.mark.parametrize(("left", "best"), [(6.0, {"gravity"}), (12.0, {"gravity", "friction"})])
def test_second_effect_that_is_improbable_is_named_only_where_the_first_is_incomplete(left, best):
    """It leaves more than three times the noise."""
    singles = [model("gravity", left, 2), model("friction", 8300.0)]
    decision = decide(base(8450.0), [*singles, model("gravity+friction", 1.1, 3)])
    assert (decision.verdict, decision.best) == ("named", best)


def test_pair_is_not_given_up_for_one_of_its_own_effects():
    """The simpler of two pairs of the same families, which the fuller one hardly betters."""
    pairs = [
        model("a+b", 5.5, 2)._replace(families=frozenset({"a", "f"})),
        model("a+c", 4.0, 4)._replace(families=frozenset({"a", "f"})),
    ]
    models = [model("a", 10.0, 1), *pairs]
    assert decide(base(200.0), models).best == {"a", "b"}


def test_where_no_name_is_believed_the_reason_tells_the_share_of_the_best_one():
    others = [model("load_friction", 15.0), model("coulomb_friction", 10.5)]
    fits = {m.names: SimpleNamespace(effects=[EFFECTS[n] for n in m.names]) for m in others}
    models = SimpleNamespace(
        judged=lambda _: [base(20.0), *others], base=None, singles=[], with_effects=fits
    )
    conclusion = conclude(None, models)
    assert conclusion.verdict == "unknown"
    title = EFFECTS["coulomb_friction"].title
    assert conclusion.reason == f"The best of them, {title}, explains 50 % of it."


def test_rest_looks_like_the_nameless_law_that_takes_most_of_it_off():
    """Of what gravity leaves; nothing is said of a law that leaves nearly all of it."""
    laws = {"gauge_loop": 18.0, "cable_bend": 4.0, "cable_loop": 8.0}
    named = {"link_gravity": EFFECTS["link_gravity"]} | {e.name: e for e in NAMELESS}
    fits = {frozenset({name}): SimpleNamespace(effects=[e]) for name, e in named.items()}
    models = SimpleNamespace(with_effects=fits)
    decision = Decision("incomplete", frozenset({"link_gravity"}))

    def rest_of(*names):
        found = [model(name, laws[name], 3, named=False) for name in names]
        return _rest(models, decision, [model("link_gravity", 20.0), *found])

    bend = next(e for e in NAMELESS if e.name == "cable_bend")
    assert rest_of("gauge_loop", "cable_bend", "cable_loop") == bend.title
    assert not rest_of("gauge_loop")


def test_no_pair_is_named_for_another_that_is_rather_not_there():
    """Of a backlash that is not determined alone, with one of two effects that add nothing."""
    play = model("play", 2.56, 2, eligible=False)
    pairs = [model("play+gravity", 2.52, 3), model("play+friction", 2.55, 3)]
    assert not decide(base(14.5), [play, *pairs]).best


def test_law_with_fewer_values_that_does_about_as_well_is_likelier():
    assert decide(base(50.0), [model("a", 1.3, 4), model("b", 1.6, 1)]).best == {"b"}


def test_effect_that_may_not_be_named_is_neither_chosen_as_the_likelier_nor_a_rival():
    for J in (1.6, 1.3):
        models = [model("a", 1.3, 4), model("b", J, 1, eligible=False)]
        decision = decide(base(50.0), models)
        assert (decision.verdict, decision.best, decision.tied) == ("named", {"a"}, ())


def test_effect_whose_size_a_scale_tells_is_less_likely_than_another():
    weighed = model("weight", 0.95, 1, known_apart=True)
    for J in (0.9, 1.0):
        decision = decide(base(3.0), [weighed, model("stiff", J, 2)])
        assert (decision.verdict, decision.best, decision.tied) == ("named", {"stiff"}, ())


def test_nameless_law_with_as_few_values_refutes_a_name():
    laws = [model("a", 8.0, 2), model("loop", 1.1, 2, named=False)]
    decision = decide(base(50.0), laws)
    assert (decision.verdict, decision.like, decision.leading) == ("unknown", "loop", {"a"})


def test_nameless_law_with_more_values_refutes_only_what_leaves_much_more():
    curve = model("curve", 55.0, 7, named=False)
    assert decide(base(2000.0), [model("a", 100.0, 1), curve]).best == {"a"}
    assert decide(base(20_000.0), [model("a", 500.0, 1), curve]).verdict == "unknown"


def test_probabilities_sum_to_one_and_favour_fewer_values():
    models = [model("a", 1.05, 1), model("b", 1.05, 3), model("c", 5.0, 1)]
    p = probabilities(base(20.0), models)
    assert sum(p.values()) == pytest.approx(1.0)
    assert p[frozenset("a")] > 0.9 > p[frozenset("b")] > p[frozenset("c")]
    assert summed((m.families, p[m.names]) for m in models)["a"] == pytest.approx(
        p[frozenset("a")]
    )


def test_odds_of_two_models_allow_for_a_wrong_form_by_a_share_of_what_is_explained():
    a, b = model("a", 1.0, 1), model("b", 4.0, 3)
    p = probabilities(base(101.0), [a, b])
    form, n = CONSTANTS.form * 100.0, CONSTANTS.effective
    odds = 0.5 * n * math.log((4.0 + form) / (1.0 + form)) + 0.5 * (3 - 1) * math.log(n)
    assert math.log(p[a.names] / p[b.names]) == pytest.approx(odds)


def test_sums_over_families_count_every_model_with_one():
    models = [model("a", 1.0, 1), model("a+b", 1.0, 1)]
    p = probabilities(base(20.0), models)
    found = summed((m.families, p[m.names]) for m in models)
    assert found["a"] == pytest.approx(1.0, abs=1e-3)


def test_rivals_of_one_family_share_its_probability():
    members = [model(name, 2.0, family="friction") for name in ("simple", "full")]
    p = probabilities(base(100.0), members)
    assert summed((m.families, p[m.names]) for m in members)["friction"] == pytest.approx(1.0)
    own = summed((m.names, p[m.names]) for m in members)
    assert own == pytest.approx({"simple": 0.5, "full": 0.5})


@pytest.mark.parametrize(("J", "tied"), [(1.05, True), (3.0, False)])
def test_laws_of_a_family_with_as_many_values_are_rivals(J, tied):
    lag, delay = (model(name, j, family="delay") for name, j in (("lag", 1.0), ("delay", J)))
    decision = decide(base(20.0), [lag, delay])
    assert (decision.verdict == "ambiguous") is tied
    assert decision.tied == ((delay.names,) if tied else ())


def test_fuller_law_that_does_no_better_is_no_rival_of_the_simpler():
    simple, full = (model(name, 1.0, n, family="friction") for name, n in (("f", 1), ("g", 2)))
    assert decide(base(20.0), [simple, full]).verdict == "named"


def test_tie_says_how_little_its_predictions_differ():
    fits = [fitted_with(residuals) for residuals in ([1.0, -1.0, 1.0], [1.2, -0.8, 0.8])]
    assert apart_of(*fits) == pytest.approx(0.2)
    assert math.isnan(apart_of(fits[0]))
    steps = (SearchStep("", 3e-3, 1e-3, 3.0), SearchStep("coulomb_friction", 1e-3, 1e-3, 1.0))
    tied = ("coulomb_friction", "load_friction")
    conclusion = Conclusion("ambiguous", (), tied=tied, apart=0.2)
    said = verdict_sentence("ambiguous", conclusion, (), steps, "rad")
    assert "coulomb_friction from load_friction, whose predictions of them differ by 0.2" in said


def test_candidates_are_listed_best_first_each_with_the_share_that_it_explains():
    """Of two effects that were fitted, and one that the screening ruled out."""
    shares = {"backlash": None, "load_friction": 0.5, "coulomb_friction": 0.9}
    fits = [
        SimpleNamespace(effects=(EFFECTS[name],), J=1.0 + (1.0 - share) * 100.0)
        for name, share in shares.items()
        if share is not None
    ]
    declared = {
        name: SimpleNamespace(effect=EFFECTS[name], screening_R2=share or 0.01)
        for name, share in shares.items()
    }
    models = SimpleNamespace(singles=fits, base=SimpleNamespace(J=101.0))
    for believed in ((), ("load_friction",)):
        stage = SimpleNamespace(effects=tuple(EFFECTS[name] for name in believed))
        found = candidates(
            SimpleNamespace(declared=declared), models, Conclusion("named", (stage,))
        )
        rest = [name for name in ("coulomb_friction", "load_friction") if name not in believed]
        assert [c.name for c in found] == [*believed, *rest, "backlash"]
        by_name = {c.name: c for c in found}
        assert by_name["coulomb_friction"].closure == pytest.approx(0.9)
        assert by_name["coulomb_friction"].gap == pytest.approx(math.sqrt(11.0))
        assert "explains 90 % of the error power" in by_name["coulomb_friction"].sentence
        assert math.isnan(by_name["backlash"].closure)
        assert "explains 1 % of the residual" in by_name["backlash"].sentence
    screening, nothing = SimpleNamespace(declared=declared), SimpleNamespace(effects=())
    conclusion = Conclusion("unknown", (nothing,), like="a further mode")
    best, *_ = candidates(screening, models, conclusion)
    assert best.sentence.endswith("but a further mode explains more")


def fitted_with(residuals):
    left = np.array(residuals)
    return SimpleNamespace(fitted=SimpleNamespace(entries=np.arange(left.size), residuals=left))
