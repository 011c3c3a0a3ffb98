"""Conformance suite of a tuner; see docs/explanation/tuners.md."""

import json
import math
import pickle
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from estune.tuners import Observation, Tuner


def observations(seed: int, size: int = 40) -> list[Observation]:
    """Costs over many decades, unsafe trials among them."""
    rng = np.random.default_rng(seed)
    costs = 10.0 ** rng.uniform(-6.0, 6.0, size)
    unsafe = rng.random(size) < 0.2
    pairs = zip(costs, unsafe, strict=True)
    return [
        Observation(math.nan if bad else float(cost), censored=bool(bad)) for cost, bad in pairs
    ]


class TunerConformance:
    """Tests of a tuner: the fixture `tuner`, which a subclass must define."""

    @pytest.fixture
    def tuner(self) -> Tuner[Any]:
        """The tuner under test."""
        raise NotImplementedError("define the fixture `tuner`: your tuner in some search space")

    @pytest.mark.parametrize("seed", range(5))
    def test_proposals_stay_within_the_bounds(self, tuner: Tuner[Any], seed: int) -> None:
        state = tuner.start()
        for observation in observations(seed):
            for point in (tuner.ask(state), tuner.recommend(state)):
                rows = zip(tuner.space.low, point, tuner.space.high, strict=True)
                assert all(low <= value <= high for low, value, high in rows)
            state = tuner.tell(state, observation)

    def test_tell_leaves_the_earlier_state_unchanged(self, tuner: Tuner[Any]) -> None:
        state = tuner.start()
        for observation in observations(0, 10):
            before, proposal = pickle.dumps(state), tuner.ask(state)
            following = tuner.tell(state, observation)
            assert pickle.dumps(state) == before
            assert tuner.ask(state) == proposal
            state = following

    @pytest.mark.parametrize("cut", [0, 1, 17])
    def test_restored_state_continues_bit_for_bit(self, tuner: Tuner[Any], cut: int) -> None:
        state = stored = tuner.start()
        for k, observation in enumerate(observations(1)):
            if k == cut:
                stored = pickle.loads(pickle.dumps(stored))  # noqa: S301  our own bytes
            state, stored = tuner.tell(state, observation), tuner.tell(stored, observation)
        assert stored == state
        assert tuner.ask(stored) == tuner.ask(state)

    def test_settings_survive_json(self, tuner: Tuner[Any]) -> None:
        kind = TypeAdapter(type(tuner))
        stored = json.loads(json.dumps(kind.dump_python(tuner, mode="json")))
        assert kind.validate_python(stored) == tuner
