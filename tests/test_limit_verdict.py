"""The limits of a run judge its result, whichever tuner found it."""

import math
from dataclasses import replace

import numpy as np
import pytest

import estune
import plants
from estune.api import tune
from estune.cli import app
from estune.cli.tune import finish
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.loop_model.claim import Claim
from estune.loop_model.intervals import Interval, PredictedMargins
from estune.loop_model.optimum import RobustnessLimits
from estune.run.ending import RunEnding
from estune.run.limit_verdict import LimitState, limit_verdict, measured_overshoot
from estune.run.toml_tables import SearchTable
from estune.trial import Outcome, TrialRequest
from estune.web.result_view import shown_result
from tests.support_runs import ArithmeticRig


@pytest.fixture(scope="module")
def free(tmp_path_factory):
    """Tuned by a search that keeps no limit: the optimum of the cost overshoots by 15 %."""
    gains = Gains(0.9, 30.0, 0.015, 0.004)
    folder = tmp_path_factory.mktemp("runs")
    return tune(
        plants.reference_reel(0.8),
        tuner="safe_bayesian",
        start=gains,
        trials=30,
        folder=folder,
        run="free",
        watch=None,
    )


def test_gains_that_break_a_limit_are_not_called_tuned(free):
    assert free.ending is RunEnding.LIMIT_BROKEN
    assert free.success
    assert free.ending.exit_code == 12
    assert free.heading().startswith("TUNED, BUT A LIMIT IS BROKEN")
    assert "overshoot" in free.heading()
    assert "#d55e00" in free._repr_html_()[:200]


def test_apply_asks_before_gains_that_break_a_limit(free):
    with pytest.raises(InvalidInput, match="--yes"):
        app(["apply", str(free.folder), "plants:reference_reel"])


def test_gains_that_break_a_limit_are_offered_neither_in_the_terminal_nor_on_the_page(
    free, capsys
):
    assert finish(free, "tcp/127.0.0.1:7447") == RunEnding.LIMIT_BROKEN.exit_code
    assert "make live" not in capsys.readouterr().out
    offer = shown_result(free)["offer"]
    assert offer.keys() == {"refused"}
    assert "overshoot" in offer["refused"]


def test_comparison_puts_first_what_may_be_used(tmp_path):
    made = estune.compare(
        plants.reference_reel(0.8),
        ["safe_bayesian", "model_based"],
        start=Gains(0.9, 30.0, 0.015, 0.004),
        trials=30,
        folder=tmp_path,
        watch=None,
    )
    costs = {name: result.fun for name, result in made.results.items()}
    assert list(made.results) == ["model_based", "safe_bayesian"]
    assert costs["model_based"] > costs["safe_bayesian"]


def plan(limits):
    return tune(ArithmeticRig(), trials=1, limits=limits, journal=False, watch=None).plan


def claimed(Ms):
    return Claim(PredictedMargins(*[Interval(math.nan, 0.0, math.inf)] * 2, Ms, Ms), "", 0.0)


@pytest.mark.parametrize(
    ("Ms", "state"),
    [
        (Interval(1.55, 1.52, 1.59), LimitState.KEPT),
        (Interval(1.58, 1.55, 1.615), LimitState.KEPT),
        (Interval(1.58, 1.55, 1.62), LimitState.NOT_SHOWN),
        (Interval(1.62, 1.61, 1.63), LimitState.NOT_SHOWN),
        (Interval(1.6, 1.3, 1.9), LimitState.NOT_SHOWN),
        (Interval(2.0, 1.9, 2.1), LimitState.BROKEN),
        (Interval(1.6, math.nan, math.nan), LimitState.NOT_SHOWN),
    ],
)
def test_whole_interval_within_a_hundredth_of_the_limit_decides(Ms, state):
    limits = RobustnessLimits(max_sensitivity=1.6, max_overshoot=None)
    assert limit_verdict(plan(limits), claimed(Ms), ArithmeticRig.best, ()).state is state


@pytest.mark.parametrize(
    ("Ms", "said"),
    [
        (Interval(1.58, 1.55, 1.62), "the sensitivity Ms, 1.55 to 1.62, may be above the limit"),
        (Interval(2.0, 1.9, 2.1), "the sensitivity Ms of 2.00 is above the limit of 1.6"),
    ],
)
def test_reason_of_a_verdict_gives_the_sensitivity_as_a_plain_number(Ms, said):
    limits = RobustnessLimits(max_sensitivity=1.6, max_overshoot=None)
    assert said in limit_verdict(plan(limits), claimed(Ms), ArithmeticRig.best, ()).reason


@pytest.mark.parametrize(
    ("degrees", "state", "said"),
    [
        (Interval(40.0, 36.0, 44.0), LimitState.KEPT, ""),
        (
            Interval(36.0, 33.0, 39.0),
            LimitState.NOT_SHOWN,
            "the phase margin, 33° to 39°, may be below the limit of 35°",
        ),
        (
            Interval(30.0, 27.0, 33.0),
            LimitState.BROKEN,
            "the phase margin of 30° is below the limit of 35°",
        ),
    ],
)
def test_whole_interval_of_the_phase_margin_decides(degrees, state, said):
    limits = RobustnessLimits(None, None, min_phase_margin_deg=35.0)
    unknown = Interval(math.nan, 0.0, math.inf)
    claim = Claim(PredictedMargins(unknown, unknown, unknown, degrees), "", 0.0)
    assert limit_verdict(plan(limits), claim, ArithmeticRig.best, ()) == (state, said)


def test_overshoot_is_that_of_the_trials_with_the_very_gains():
    limits = RobustnessLimits(max_sensitivity=None, max_overshoot=0.05)
    rig, other = ArithmeticRig(), replace(ArithmeticRig.best, P=2.0)
    records = []
    for number, peak in enumerate((0.04, 0.6, 0.04, 0.5)):
        request = TrialRequest("run", number, (rig.best, other)[number % 2], rig.describe().step)
        record = rig.run(request)
        tension = record.setpoint_N.copy()
        tension[30] += peak * request.profile.step_N
        records.append(replace(record, tension_N=tension))
    made = plan(limits)
    assert measured_overshoot(made, rig.best, records).value == pytest.approx(0.04)
    unknown = Claim(None, "", math.nan)
    kept, broken = (limit_verdict(made, unknown, g, records) for g in (rig.best, other))
    assert (kept.state, broken.state) == (LimitState.KEPT, LimitState.BROKEN)
    assert broken.reason == "the overshoot of 55.0 % is above the limit of 5 %"
    stopped = [replace(r, outcome=Outcome.GUARD) for r in records]
    assert measured_overshoot(made, rig.best, stopped) is None


@pytest.mark.parametrize(("told", "low", "high"), [(0.11, 0.04, 0.11), (0.02, 0.018, 0.04)])
def test_overshoot_reaches_as_far_as_that_of_a_claim_which_the_trials_contradict(told, low, high):
    rig = ArithmeticRig()
    request = TrialRequest("run", 0, rig.best, rig.describe().step)
    record = rig.run(request)
    tension = record.setpoint_N.copy()
    tension[30] += 0.04 * request.profile.step_N
    overshoot, unknown = Interval(told, 0.9 * told, told), Interval(math.nan, 0.0, math.inf)
    margins = PredictedMargins(unknown, overshoot, unknown, unknown)
    claim = Claim(margins, "", 0.0, is_white=True)
    records = [replace(record, tension_N=tension)]
    found = measured_overshoot(plan(RobustnessLimits()), rig.best, records, claim)
    assert found == pytest.approx((0.04, low, high))


@pytest.mark.parametrize("peaks", [(0.048, 0.048), (0.04, 0.058, 0.04, 0.058)])
def test_overshoot_within_its_noise_of_the_limit_is_not_shown(peaks):
    limits = RobustnessLimits(max_sensitivity=None, max_overshoot=0.05)
    rig, rng, records = ArithmeticRig(), np.random.default_rng(3), []
    for number, peak in enumerate(peaks):
        request = TrialRequest("run", number, rig.best, rig.describe().step)
        record, size = rig.run(request), request.profile.step_N
        tension = record.setpoint_N.copy()
        tension[10:] += 0.004 * size * rng.standard_normal(tension.size - 10)
        tension[30] = record.setpoint_N[30] + peak * size
        records.append(replace(record, tension_N=tension))
    unknown = Claim(None, "", math.nan)
    assert limit_verdict(plan(limits), unknown, rig.best, records).state is LimitState.NOT_SHOWN


def test_nothing_claimed_is_not_shown_and_says_why():
    unknown = Claim(None, "the records do not excite it", math.nan)
    verdict = limit_verdict(plan(RobustnessLimits()), unknown, ArithmeticRig.best, ())
    assert verdict.ending is RunEnding.LIMITS_NOT_SHOWN
    assert "the records do not excite it" in verdict.reason
    none = plan(RobustnessLimits(None, None, None))
    assert limit_verdict(none, unknown, ArithmeticRig.best, ()).ending is RunEnding.TUNED


def test_overshoot_without_a_per_cent_sign_is_questioned():
    with pytest.raises(InvalidInput, match="did you mean 1%"):
        app(["tune", "plants:reference_reel", "--max-overshoot", "1"])
    assert SearchTable(max_overshoot="8 %").limits.max_overshoot == pytest.approx(0.08)
    with pytest.raises(ValueError, match="did you mean 5%"):
        SearchTable(max_overshoot=5.0)
