"""The `Rig` protocol of estune.trial.rig, as it is and over Zenoh."""

import threading
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.trial import Outcome, TrialRequest
from estune.trial.profiles import (
    ChirpProfile,
    MultisineProfile,
    StaircaseProfile,
    TriangleProfile,
)
from tests.serve_rig import hosted, make
from tests.support_rigs import same

OTHER = Gains(0.7, 12.0, 0.004, 0.01)


@pytest.fixture(scope="module")
def endpoints():
    """Endpoint of a served rig of each kind, served when first needed."""
    with ExitStack() as stack:
        found: dict[str, str] = {}

        def endpoint(kind: str) -> str:
            if kind not in found:
                found[kind] = stack.enter_context(hosted(kind))
            return found[kind]

        yield endpoint


@pytest.fixture
def make_rig_at(endpoints):
    """Makes a rig of a kind, as it is ("here") or over the link ("zenoh")."""
    with ExitStack() as stack:

        def make_rig_at(where: str, kind: str):
            rig = make(kind, "reel") if where == "here" else zenoh.connect(endpoints(kind))
            stack.callback(rig.close)
            return rig

        yield make_rig_at


@pytest.fixture(params=["here", "zenoh"])
def make_rig(request, make_rig_at):
    """Makes a rig of a kind, in either place."""
    return partial(make_rig_at, request.param)


# Hardware is served only: the rig itself is the same, and takes a second to start.
RIGS = ["here scripted", "here simulated", "zenoh scripted", "zenoh simulated", "zenoh hardware"]


@pytest.fixture(params=RIGS)
def rig(request, make_rig_at):
    return make_rig_at(*request.param.split())


@pytest.fixture
def trial(request):
    """A request under a run name of its own, since the served rigs outlive the test."""

    def trial(rig, number: int = 0, **changes) -> TrialRequest:
        step = replace(rig.describe().step, **changes)
        return TrialRequest(request.node.name.replace("[", " ").rstrip("]"), number, OTHER, step)

    return trial


def test_describe_is_constant_and_within_its_own_limits(rig):
    description = rig.describe()
    assert description.name == "reel"
    description.limits.check(description.step)
    assert rig.describe() == description


def test_run_returns_the_record_of_the_request(rig, trial):
    request = trial(rig)
    record = rig.run(request)
    rate = rig.describe().controller.sampling_Hz
    assert (record.trial_id, record.rig, record.outcome) == (
        *(request.trial_id, "reel", Outcome.DONE),
    )
    assert record.gains == OTHER
    assert record.sampling_Hz == rate
    np.testing.assert_array_equal(record.setpoint_N, request.profile.setpoint(rate))
    for column in (record.time_s, record.tension_N, record.current_A, record.angle_rad):
        assert column.shape == record.flags.shape == record.setpoint_N.shape
        assert np.all(np.isfinite(column))


EXCITATIONS = [
    TriangleProfile(15.0, 5.0, 0.2, 0.5, 0.1, shrink=0.5),
    MultisineProfile(15.0, 1.0, 0.2, 1, 15, 0.5, 0.1, lines="odd_sparse"),
    ChirpProfile(15.0, 2.0, 0.0, 30.0, 0.5, 0.1),
    StaircaseProfile(15.0, 2.0, 3, 0.05, 0.5, 0.1),
]


@pytest.mark.parametrize("loop", ["closed", "open"])
@pytest.mark.parametrize("profile", EXCITATIONS, ids=lambda profile: profile.kind)
def test_run_supports_every_profile_in_both_loops(rig, trial, profile, loop):
    request = replace(trial(rig), profile=replace(profile, loop=loop))
    record = rig.run(request)
    assert (record.outcome, record.loop, record.profile) == (Outcome.DONE, loop, profile.kind)
    assert record.preload_N == profile.preload_N
    np.testing.assert_array_equal(record.setpoint_N, profile.setpoint(record.sampling_Hz))
    assert np.all(np.isfinite(record.tension_N))
    other = replace(profile, loop="open" if loop == "closed" else "closed")
    with pytest.raises(RigError, match=request.trial_id):
        rig.run(replace(request, profile=other))


def test_run_repeated_returns_the_same_record(rig, trial):
    first = rig.run(trial(rig))
    rig.run(trial(rig, 1))
    assert same(first, rig.run(trial(rig)))


def test_run_of_another_request_under_a_used_id_is_refused(rig, trial):
    rig.run(trial(rig))
    with pytest.raises(RigError, match=trial(rig).trial_id):
        rig.run(replace(trial(rig), gains=replace(OTHER, P=OTHER.P * 1.5)))


def test_run_outside_the_limits_is_refused(rig, trial):
    limits = rig.describe().limits
    with pytest.raises(InvalidInput, match="outside the rig's range"):
        rig.run(trial(rig, step_N=2.0 * limits.tension_max_N))
    with pytest.raises(InvalidInput, match="longer than the rig's limit"):
        rig.run(trial(rig, duration_s=1.01 * limits.duration_max_s))
    assert rig.run(trial(rig)).outcome is Outcome.DONE


def test_run_leaves_the_live_gains_unchanged(rig, trial):
    before = rig.describe()
    assert rig.run(trial(rig)).gains != before.gains
    assert rig.describe() == before


def test_apply_sets_the_live_gains(rig):
    before = rig.describe().gains
    rig.apply(OTHER)
    assert rig.describe().gains == OTHER
    rig.apply(before)
    assert rig.describe().gains == before


def test_abort_of_an_idle_rig_has_no_effect(rig, trial):
    assert rig.abort() == rig.describe()
    assert rig.run(trial(rig)).outcome is Outcome.DONE


@pytest.mark.parametrize("kind", ["slow scripted", "slow simulated", "slow hardware"])
def test_abort_stops_the_active_trial(make_rig, kind, trial):
    rig = make_rig(kind)
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


def test_run_that_diverges_returns_a_record(make_rig, trial):
    rig = make_rig("diverging")
    record = rig.run(trial(rig))
    assert record.outcome is Outcome.DIVERGED
    assert "sample 50" in record.reason
    assert np.isnan(record.tension_N[50:-1]).all()
    assert record.tension_N[-1] == np.inf


def test_closed_rig_refuses_calls(rig, trial):
    request = trial(rig)
    rig.close()
    for call in (rig.describe, rig.abort, lambda: rig.run(request), lambda: rig.apply(OTHER)):
        with pytest.raises(RigError, match="closed"):
            call()
    rig.close()


@pytest.mark.parametrize("kind", ["scripted", "simulated"])
def test_link_leaves_records_unchanged(endpoints, kind, trial):
    here = make(kind, "reel")
    with zenoh.connect(endpoints(kind)) as there:
        assert there.describe() == here.describe()
        for number in range(3):
            one, other = here.run(trial(here, number)), there.run(trial(there, number))
            assert same(replace(one, started_at=other.started_at), other)
    here.close()
