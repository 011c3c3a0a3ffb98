"""Whether a watched loop has another plant: what records show of it adds up, and one may err."""

import pytest

from estune.service_records.plant_change import chance, evidence
from estune.service_records.watched_loop import WatchedLoop, observe
from experiments.margin_watch import CHANGE, case_of

CASE = case_of("20 Hz")
RATE, SETTLING_S = CASE.trial.controller.sampling_Hz, CASE.trial.cost.settling_time_s


@pytest.fixture(scope="module")
def known():
    loop = WatchedLoop()
    for seed in range(3):
        loop, _ = observe(loop, CASE.record(seed), RATE, SETTLING_S)
    return loop


def observed(loop, records):
    changes = []
    for record in records:
        loop, changed = observe(loop, record, RATE, SETTLING_S)
        changes.append(changed)
    return loop, changes


@pytest.mark.slow
def test_what_records_show_of_a_small_change_adds_up(known):
    shown = [evidence(known.fit, CASE.record(seed, gain=1.15)) for seed in range(10, 16)]
    likely = [chance(known.fit, known.known, shown[:count]) for count in (1, 6)]
    assert likely[1] < 0.01 * likely[0]


def test_a_gain_that_changes_is_noticed_and_its_records_are_the_new_loop(known):
    loop, changes = observed(known, [CASE.record(seed, gain=CHANGE) for seed in range(20, 26)])
    assert changes.count(True) == 1
    gain = loop.fit.model.static_gain / known.fit.model.static_gain
    assert gain == pytest.approx(CHANGE, rel=0.15)


@pytest.mark.slow
def test_one_disturbed_record_is_no_change(known):
    knock = CASE.record(30)
    knock.measurement[1000:1100] += 0.2 * CASE.trial.step.size
    quiet = [CASE.record(seed) for seed in range(31, 36)]
    loop, changes = observed(known, [knock, *quiet])
    assert chance(known.fit, known.known, [evidence(known.fit, knock)]) < 1e-6
    assert not any(changes)
    assert not any(record is knock for record in loop.records)
    assert loop.fit is not known.fit  # the others are taken


def test_a_record_set_apart_before_a_change_does_not_hide_it(known):
    loop, _ = observed(known, [CASE.record(45, gain=0.8)])
    assert loop.suspects
    _, changes = observed(loop, [CASE.record(seed, gain=CHANGE) for seed in range(41, 45)])
    assert changes.count(True) == 1
