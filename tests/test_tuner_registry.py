"""Tuners by name, and their stored form."""

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from estune import api
from estune.errors import InvalidInput, JournalError
from estune.tuners import (
    TUNERS,
    Observation,
    SearchSpace,
    create_tuner,
    tuner_class,
    tuner_from_stored,
    tuner_name,
    tuner_space,
    tuner_to_stored,
)
from estune.tuners.extremum_seeking import ExtremumSeekingState, Otis
from tests.support_runs import START, ArithmeticRig

SPACE = SearchSpace.around(START)
STORED_SPACE = tuner_to_stored(create_tuner("otis", SPACE))["space"]


@dataclass(frozen=True)
class OwnTuner:
    """Tuner of a user: stays at the initial gains."""

    space: SearchSpace
    width: float = 0.1
    name: str = field(default="own")

    def start(self) -> ExtremumSeekingState:
        return Otis(self.space).start()

    def ask(self, state: ExtremumSeekingState) -> tuple[float, ...]:
        return state.best_point

    def tell(self, state: ExtremumSeekingState, observation: Observation) -> ExtremumSeekingState:
        return state._replace(k=state.k + 1, best_cost=observation.cost)

    def recommend(self, state: ExtremumSeekingState) -> tuple[float, ...]:
        return state.best_point


class NotATuner:
    """Class without the methods of a tuner."""


def stored_form(tuner: Any) -> dict[str, Any]:
    """Stored form after encoding and decoding as JSON."""
    values: dict[str, Any] = json.loads(json.dumps(tuner_to_stored(tuner)))
    return values


@pytest.mark.parametrize("name", TUNERS)
def test_registered_tuner_is_stored_by_name_and_read_back(name):
    tuner = create_tuner(name, SPACE)
    assert tuner.name == name
    assert stored_form(tuner)["kind"] == name
    assert tuner_from_stored(stored_form(tuner)) == tuner
    assert tuner_name(stored_form(tuner)) == name
    assert tuner_space(stored_form(tuner)) == SPACE


def test_user_tuner_by_module_and_class_survives_storage():
    reference = f"{__name__}:OwnTuner"
    tuner = replace(create_tuner(reference, SPACE), width=0.3)
    assert stored_form(tuner)["kind"] == reference
    assert tuner_from_stored(stored_form(tuner)) == tuner
    assert tuner_name(stored_form(tuner)) == "own"


def test_page_of_tuners_lists_the_table():
    page = (Path(__file__).parents[1] / "docs" / "explanation" / "tuners.md").read_text("utf-8")
    rows = [f"| `{name}` | {entry.method} | {entry.purpose} |" for name, entry in TUNERS.items()]
    text = "\n".join(rows)
    assert text in page, f"copy these rows to docs/explanation/tuners.md:\n{text}"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("optuna", "the tuners are model_based, "),
        ("nowhere:Thing", "no module 'nowhere'"),
        (f"{__name__}:Nothing", "has no 'Nothing'"),
        (f"{__name__}:NotATuner", "must be a dataclass with the methods start, ask"),
        (":Thing", "has no 'Thing'"),
        ("estune:", "has no ''"),
    ],
)
def test_unknown_tuner_is_refused_with_a_remedy(name, message):
    with pytest.raises(InvalidInput, match=message):
        tuner_class(name)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "estune.core.tuners.gone:Gone"}, "another version"),
        ({"kind": "otis", "boldness": 2.0}, "settings of another version: boldness"),
        ({"kind": "otis", "washout_h": 2.0}, "washout_h"),
        ({}, "another version"),
    ],
)
def test_stored_tuner_that_cannot_be_made_is_a_journal_error(values, message):
    with pytest.raises(JournalError, match=message):
        tuner_from_stored({"space": STORED_SPACE, **values})


def test_settings_survive_bit_for_bit():
    tuner = Otis(SPACE, adaptation_gain=math.nextafter(0.1, 1.0))
    assert tuner_from_stored(stored_form(tuner)) == tuner


def test_run_with_an_own_tuner_is_journalled_and_loaded(tmp_path):
    options = {"trials": 12, "repeats": 2, "run": "own", "watch": None, "folder": tmp_path}
    done = api.tune(ArithmeticRig(), tuner=f"{__name__}:OwnTuner", **options)
    again = api.load(tmp_path / "own")
    assert again.gains == done.gains
    assert len(again.entries) == len(done.entries) > 12
