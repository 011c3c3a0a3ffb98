"""Suggestions from whole logs: warm-ups at a limit, short logs, and verdicts that do not flip."""

import math

import numpy as np
import pytest

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.loop_model.margins import robustness
from estune.recordings.loop_log import LoopLog
from estune.service_records.suggestion import Suggestion, suggest
from experiments.service_records.keep import judged as judged_beside_truth
from experiments.service_records.short_logs import verdict
from tests.support_loops import loop_of_taps

FORM = ControllerForm(integral="backward")
PLANT = loop_of_taps((-1.8, 0.805), (0.0004,), 2)  # two lags of 10 and 15 samples
GAINS = Gains(60.0, 2.0, 0.0, 0.0)


def warm_up(rows: int = 240, *, scale: float = 1.0, begun_s: float = 0.0) -> LoopLog:
    """A cold start at the limit to one setpoint, a sample a second."""
    rng = np.random.default_rng(4)
    y, u, sums = np.zeros(rows), np.zeros(rows), 0.0
    measured = np.zeros(rows)
    for k in range(rows):
        past = u[k - 3] if k >= 3 else 0.0
        y[k] = 1.8 * y[max(k - 1, 0)] - 0.805 * y[max(k - 2, 0)] + 0.0004 * past if k else 0.0
        measured[k] = y[k] + 0.005 * rng.standard_normal()
        error = 5.0 - measured[k]
        sums = min(max(sums + GAINS.I * error, 0.0), 100.0)
        u[k] = min(max(GAINS.P * error + sums, 0.0), 100.0)
    columns = {
        "time": begun_s + np.arange(rows),
        "setpoint": np.full(rows, 20.0 + 5.0) * scale,
        "measurement": (20.0 + measured) * scale,
        "effort": u,
    }
    return LoopLog("warm-up.csv", 1.0, (columns,), None, {}, {}, ())


def judged(log: LoopLog, gains: Gains = GAINS) -> Suggestion:
    return suggest([log], gains=gains, form=FORM)


def test_a_warm_up_at_the_limit_with_one_setpoint_shows_ms():
    found = judged(warm_up())

    assert found.margins is not None
    Ms = found.margins.sensitivity
    true = robustness(PLANT, GAINS, found.trial.controller).sensitivity
    assert math.isfinite(true)
    assert Ms.low <= true <= Ms.high
    assert Ms.high < 1.2 * Ms.low


@pytest.mark.slow
def test_verdict_is_the_same_for_a_row_less_other_units_a_later_start_and_rounded_gains():
    first = judged(warm_up())

    others = [
        judged(warm_up(239)),
        judged(warm_up(scale=100.0), Gains(0.6, 0.02, 0.0, 0.0)),
        judged(warm_up(begun_s=1e6)),
        judged(warm_up(), Gains(60.01, 2.0003, 0.0, 0.0)),
    ]

    assert {one.verdict for one in others} == {first.verdict}


def test_random_short_logs_end_in_a_verdict_or_a_refusal_of_one_line():
    said = [verdict(seed)[0] for seed in (2, 29, 61, 64, 70, 77)]

    assert not [one for one in said if one.startswith("failed")]


def kettle(gains: Gains, rows: int = 1200) -> LoopLog:
    """A cold start of `PLANT` with an effort from 0 to 100, a sample a second."""
    y, u, sums = np.zeros(rows), np.zeros(rows), 0.0
    rng = np.random.default_rng(7)
    measured = np.zeros(rows)
    for k in range(rows):
        if k >= 3:
            y[k] = 1.8 * y[k - 1] - 0.805 * y[k - 2] + 0.0004 * u[k - 3]
        measured[k] = round(y[k] + 0.002 * rng.standard_normal(), 3)
        sums = min(max(sums + gains.I * (2.0 - measured[k]), 0.0), 100.0)
        u[k] = min(max(gains.P * (2.0 - measured[k]) + sums, 0.0), 100.0)
    columns = {
        "time": np.arange(rows) * 1.0,
        "setpoint": np.full(rows, 2.0),
        "measurement": measured,
        "effort": u,
    }
    return LoopLog("kettle.csv", 1.0, (columns,), None, {}, {}, ())


@pytest.mark.parametrize(("P", "stable"), [(150.0, True), (400.0, False)])
def test_a_loop_that_rings_at_one_setpoint_is_told_with_its_period_and_gains_that_hold(P, stable):
    gains = Gains(P, 5.0, 0.0, 0.0)
    found = judged(kettle(gains), gains)

    rings = found.judgement.ringing
    assert rings is not None
    assert rings.stable == stable == (found.margins is not None)
    assert found.verdict == "change"
    better = robustness(PLANT, found.recommendation.gains, found.trial.controller).sensitivity
    assert better <= 1.6
    assert any("period" in remark for remark in found.remarks())


@pytest.mark.parametrize(
    ("seed", "at_optimum", "said"),
    [
        # The judge of causes takes the setpoint filter of this one for a sticking actuator.
        (11, True, "keep"),
        (11, False, "change"),
        *(pytest.param(seed, True, "keep", marks=pytest.mark.slow) for seed in (4, 15, 25)),
    ],
)
def test_keep_is_said_of_a_loop_at_its_optimum_and_change_of_others(seed, at_optimum, said):
    found = judged_beside_truth(seed, at_optimum=at_optimum)

    assert found.said == said
    assert not found.false
