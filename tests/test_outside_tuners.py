"""Tuners of other libraries promise what ours do, but for caution."""

import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from estune import api
from estune.errors import InvalidInput
from estune.run.plan import make_tuner
from estune.tuners import state_from_json, state_to_json
from estune.tuners.external import OUTSIDE, optimiser_cache, tuner_class
from estune.tuners.observation import Observation
from estune.tuners.search_space import SearchSpace
from tests.support_runs import START, ArithmeticRig

SPACE = SearchSpace.around(START, 30.0)
ALL = {name: tuner_class(name)(space=SPACE) for name in OUTSIDE}
every_tuner = pytest.mark.parametrize("tuner", ALL.values(), ids=ALL.keys())
CENSORED = Observation(math.nan, censored=True)

_KILLED = """
import os, signal, sys, estune
from tests.support_runs import ArithmeticRig
class Killed(ArithmeticRig):
    def run(self, request):
        if request.number == 20:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().run(request)
estune.tune(Killed(), tuner=sys.argv[1], folder=sys.argv[2], run="run", trials=30, watch=None)
"""


def bowl(point, noise=0.0):
    """A cost of one at its best, and quadratic in the logarithms."""
    away = np.log(point) - np.log([0.8, 35.0, 0.02, 0.015])
    return (1.0 + float(away @ away)) * (1.0 + noise)


def observations(count):
    """Noise of 3 % and an unsafe trial now and then."""
    noise = np.random.default_rng(1).normal(0.0, 0.03, count)
    return [None if k % 9 == 5 else float(z) for k, z in enumerate(noise)]


def told(tuner, state, noises):
    """Proposals and the state after these trials, None being censored."""
    asked = []
    for noise in noises:
        asked.append(tuner.ask(state))
        observation = CENSORED if noise is None else Observation(bowl(asked[-1], noise))
        state = tuner.tell(state, observation)
    return asked, state


@every_tuner
def test_a_stored_state_goes_on_bit_for_bit_without_what_was_kept(tuner):
    noises = observations(60)
    asked, state = told(tuner, tuner.start(), noises)
    before, stored = told(tuner, tuner.start(), noises[:33])
    optimiser_cache._kept.clear()
    stored = state_from_json(tuner, json.loads(json.dumps(state_to_json(stored))))
    after, stored = told(tuner, stored, noises[33:])
    assert before + after == asked
    assert stored == state
    assert tuner.ask(stored) == tuner.ask(state)


@every_tuner
def test_two_searches_in_turns_do_not_disturb_each_other(tuner):
    one, other = observations(20), observations(20)[::-1]
    alone = told(tuner, tuner.start(), one), told(tuner, tuner.start(), other)
    states, asked = [tuner.start()] * 2, ([], [])
    for noises in zip(one, other, strict=True):
        for n, noise in enumerate(noises):
            points, states[n] = told(tuner, states[n], [noise])
            asked[n].extend(points)
    assert [(points, state) for points, state in zip(asked, states, strict=True)] == list(alone)


@every_tuner
def test_the_search_starts_at_the_start_and_descends_within_the_bounds(tuner):
    asked, state = told(tuner, tuner.start(), observations(90))
    assert asked[0] == pytest.approx(SPACE.start, rel=1e-12)
    for point in asked:
        rows = zip(SPACE.low, point, SPACE.high, strict=True)
        assert all(low <= value <= high for low, value, high in rows)
    assert bowl(tuner.recommend(state)) - 1.0 < 0.1 * (bowl(SPACE.start) - 1.0)


@every_tuner
def test_a_censored_trial_is_never_recommended(tuner):
    _, state = told(tuner, tuner.start(), [None] * 12)
    assert tuner.recommend(state) == SPACE.start
    assert state.best_cost is None
    with pytest.raises(InvalidInput, match="censored=True"):
        tuner.tell(state, Observation(math.inf))


@every_tuner
def test_settings_survive_a_journal(tuner):
    kind = TypeAdapter(type(tuner))
    assert kind.validate_python(json.loads(json.dumps(kind.dump_python(tuner)))) == tuner


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_run_that_was_killed_goes_on_as_if_it_had_not_been(name, tmp_path):
    killed = subprocess.run(
        [sys.executable, "-c", _KILLED, name, tmp_path],
        cwd=Path(__file__).parents[1],
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    resumed = api.resume(tmp_path / "run", ArithmeticRig(), watch=None)
    whole = api.tune(ArithmeticRig(), tuner=name, trials=30, run="run", journal=False, watch=None)
    rows = [[(e.number, e.gains, e.cost) for e in run.entries] for run in (resumed, whole)]
    assert rows[0] == rows[1]
    assert len(rows[0]) > 30


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_library_that_is_missing_is_named_with_its_remedy(name, monkeypatch):
    monkeypatch.setattr(optimiser_cache.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InvalidInput, match=r"pip install estune\[peers\]"):
        make_tuner(name, START, None)


@pytest.mark.parametrize(
    ("name", "setting", "value"),
    [
        ("optuna", "startup_trials", 0),
        ("optuna", "seed", -1),
        ("bobyqa", "radius", math.nan),
        ("bobyqa", "least_radius", 0.6),
        ("bobyqa", "radius", 4.0),
        ("bobyqa", "space", SearchSpace(("P",), (1.0,), (0.1,), (9.0,), scale="linear")),
    ],
)
def test_a_setting_out_of_its_range_is_refused_by_name(name, setting, value):
    with pytest.raises(InvalidInput, match=setting):
        tuner_class(name)(**{"space": SPACE, setting: value})
