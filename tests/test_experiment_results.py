"""Output of an experiment: figures as tables, one JSON object, exit code."""

import json
import math

from experiments.results import at_most, between, print_results

FIGURES = {
    "trials": 12,
    "by reel": {
        "left": {"cost": 0.25, "remark": "quiet"},
        "right": {"cost": None, "remark": "two words", "drift": 1e-9},
    },
    "shares": {"kept": 0.5, "lost": [1, 2]},
}


def test_figures_are_printed_as_lines_and_tables_with_their_targets(capsys):
    targets = {"cost": at_most(0.25, 0.3), "share": between(math.nan, 0.0, 1.0)}
    assert print_results(FIGURES, targets, as_json=False, tables=True) == 1
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["trials", "12"] in lines
    assert ["cost", "remark", "drift"] in lines
    assert ["left", "0.25", "quiet", "none"] in lines
    assert ["right", "none", "two", "words", "1e-09"] in lines
    assert ["lost", "1", "2"] in lines
    assert ["met", "cost:", "0.25,", "limit", "0.3"] in lines
    assert ["MISSED", "share:", "nan,", "limit", "0", "to", "1"] in lines


def test_json_output_is_one_object_without_numbers_that_json_lacks(capsys):
    targets = {"cost": at_most(math.inf, 0.3)}
    assert print_results({"cost": math.inf}, targets, as_json=True, tables=True) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["figures"] == {"cost": None}
    assert printed["targets"]["cost"] == {"value": None, "limit": 0.3, "met": False}
