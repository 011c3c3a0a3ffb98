"""What every rig promises, in this process and over Zenoh: the `Rig` protocol of estune.trial."""

import threading
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from estune import bus
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.trial import Outcome, TrialRequest
from tests.serve_rig import make, served
from tests.support_rigs import same

OTHER = Gains(0.7, 12.0, 0.004, 0.01)


@pytest.fixture(scope="module")
def endpoints():
    """Where a rig of each kind is served; one process per kind, started when first asked for."""
    with ExitStack() as stack:
        found: dict[str, str] = {}

        def endpoint(kind: str) -> str:
            if kind not in found:
                found[kind] = stack.enter_context(served(kind)).endpoint
            return found[kind]

        yield endpoint


@pytest.fixture(params=["here", "zenoh"])
def reach(request, endpoints):
    """Gives a rig of a kind, in this process or in another."""
    with ExitStack() as stack:

        def reach(kind: str):
            here = request.param == "here"
            rig = make(kind, "reel") if here else bus.connect(endpoints(kind))
            stack.callback(rig.close)
            return rig

        yield reach


@pytest.fixture(params=["scripted", "simulated"])
def rig(request, reach):
    return reach(request.param)


@pytest.fixture
def trial(request):
    """A request under a run name of its own, since the served rigs outlive the test."""

    def trial(rig, number: int = 0, **changes) -> TrialRequest:
        step = replace(rig.describe().step, **changes)
        return TrialRequest(request.node.name.replace("[", " ").rstrip("]"), number, OTHER, step)

    return trial


def test_a_rig_says_what_it_is(rig):
    description = rig.describe()
    assert description.name == "reel"
    description.limits.check(description.step)
    assert rig.describe() == description


def test_a_trial_is_answered_with_its_record(rig, trial):
    request = trial(rig)
    record = rig.run(request)
    rate = rig.describe().controller.sampling_Hz
    assert (record.trial_id, record.rig, record.outcome) == (
        *(request.trial_id, "reel", Outcome.DONE),
    )
    assert record.gains == OTHER
    assert record.sampling_Hz == rate
    np.testing.assert_array_equal(record.setpoint_N, request.step.setpoint(rate))
    for column in (record.time_s, record.tension_N, record.current_A, record.angle_rad):
        assert column.shape == record.flags.shape == record.setpoint_N.shape
        assert np.all(np.isfinite(column))


def test_a_trial_asked_for_again_is_not_run_again(rig, trial):
    first = rig.run(trial(rig))
    rig.run(trial(rig, 1))
    assert same(first, rig.run(trial(rig)))


def test_a_trial_id_stands_for_one_request(rig, trial):
    rig.run(trial(rig))
    with pytest.raises(RigError, match=trial(rig).trial_id):
        rig.run(replace(trial(rig), gains=replace(OTHER, P=OTHER.P * 1.5)))


def test_a_step_outside_the_limits_is_refused(rig, trial):
    limits = rig.describe().limits
    with pytest.raises(InvalidInput, match="outside the rig's range"):
        rig.run(trial(rig, step_N=2.0 * limits.tension_max_N))
    with pytest.raises(InvalidInput, match="longer than the rig's limit"):
        rig.run(trial(rig, duration_s=1.01 * limits.duration_max_s))
    assert rig.run(trial(rig)).outcome is Outcome.DONE


def test_a_trial_leaves_the_live_gains_alone(rig, trial):
    before = rig.describe()
    assert rig.run(trial(rig)).gains != before.gains
    assert rig.describe() == before


def test_gains_applied_are_live_until_others_are(rig):
    before = rig.describe().gains
    rig.apply(OTHER)
    assert rig.describe().gains == OTHER
    rig.apply(before)
    assert rig.describe().gains == before


def test_an_idle_rig_can_be_aborted(rig, trial):
    assert rig.abort() == rig.describe()
    assert rig.run(trial(rig)).outcome is Outcome.DONE


@pytest.mark.parametrize("kind", ["slow scripted", "slow simulated"])
def test_abort_stops_the_trial_under_way(reach, kind, trial):
    rig = reach(kind)
    before = rig.describe()
    records = []
    running = threading.Thread(target=lambda: records.append(rig.run(trial(rig))))
    running.start()
    while running.is_alive():  # the first calls may come before the trial has begun
        assert rig.abort() == before
        running.join(0.05)
    (record,) = records
    assert record.outcome is Outcome.CANCELLED
    assert record.reason
    assert len({len(record.time_s), len(record.tension_N), len(record.flags)}) == 1


def test_a_diverged_trial_is_a_record_like_any_other(reach, trial):
    rig = reach("diverging")
    record = rig.run(trial(rig))
    assert record.outcome is Outcome.DIVERGED
    assert "sample 50" in record.reason
    assert np.isnan(record.tension_N[50:-1]).all()
    assert record.tension_N[-1] == np.inf


def test_a_closed_rig_refuses_further_calls(rig, trial):
    request = trial(rig)
    rig.close()
    for call in (rig.describe, rig.abort, lambda: rig.run(request), lambda: rig.apply(OTHER)):
        with pytest.raises(RigError, match="closed"):
            call()
    rig.close()


@pytest.mark.parametrize("kind", ["scripted", "simulated"])
def test_the_link_changes_nothing_in_a_record(endpoints, kind, trial):
    here = make(kind, "reel")
    with bus.connect(endpoints(kind)) as there:
        assert there.describe() == here.describe()
        for number in range(3):
            one, other = here.run(trial(here, number)), there.run(trial(there, number))
            assert same(replace(one, started_at=other.started_at), other)
    here.close()
