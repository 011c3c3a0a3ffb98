"""Tuners compared on one target."""

import json
import re
from functools import partial

import pandas as pd
import pytest

import estune
import plants
from estune.cli import run
from estune.errors import InvalidInput
from estune.studies.compare.comparison import compare
from estune.studies.compare.report import page
from estune.support.html_page import render

BOTH = ["model_based", "otis"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    reel = plants.reference_reel()
    return compare(reel, BOTH, trials=4, tolerance=0.0, repeats=2, folder=folder, watch=None)


def test_compared_tuners_share_start_step_cost_and_budget(made):
    plans = [result.plan for result in made.results.values()]
    assert {(p.start, p.step, p.cost, p.trials) for p in plans} == {
        (plans[0].start, plans[0].step, plans[0].cost, 4)
    }
    assert [p.tuner.name for p in plans] == BOTH
    assert [result.nit for result in made.results.values()] == [4, 4]


def test_comparison_continues_where_it_was_stopped(made):
    counts = {name: result.nfev for name, result in made.results.items()}

    def refuse(_):
        raise AssertionError("no trial is left to run")

    again = compare(plants.reference_reel(), BOTH, folder=made.folder, watch=refuse)
    assert {name: result.nfev for name, result in again.results.items()} == counts


@pytest.mark.usefixtures("undrawn")
def test_comparison_page_has_both_figures_each_tuner_and_their_numbers(made):
    text = render(page(made))
    for name, result in made.results.items():
        assert name in text
        assert f"{result.fun:.4g}" in text
    assert text.count("data:image/svg+xml") >= 2
    assert not re.search(r"(?:src|href)=['\"]https?://", text)


@pytest.mark.usefixtures("undrawn")
def test_compare_command_prints_table_or_json_and_writes_its_files(tmp_path, capsys):
    command = ["compare", "plants:reference_reel", "--tuners", ",".join(BOTH), "--trials", "3"]
    command += ["--repeats", "2", "--quiet", "--folder", str(tmp_path)]
    assert run([*command, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told) == BOTH
    assert [len(told[name]["costs"]) for name in BOTH] == [told[n]["search_trials"] for n in BOTH]
    table = pd.read_csv(tmp_path / "comparison.csv")
    assert table["cost"].tolist() == pytest.approx([told[name]["cost"] for name in BOTH])
    assert run(command) == 0  # from the runs that are there
    out = capsys.readouterr().out
    assert all(name in out for name in (*BOTH, "comparison.html", "comparison.png"))
    assert (tmp_path / "comparison.png").stat().st_size > 10_000


@pytest.mark.parametrize("tuners", [["otis"], ["otis", "otis"], ["otis", "nothing"]])
def test_comparison_refuses_fewer_than_two_tuners_that_exist(tuners, tmp_path):
    tune = partial(estune.compare, plants.reference_reel(), folder=tmp_path, watch=None)
    with pytest.raises(InvalidInput):
        tune(tuners)
    assert not list(tmp_path.iterdir())
