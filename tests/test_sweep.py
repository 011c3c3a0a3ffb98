"""Sweeps: valid designs only, each finished cell is stored, no cell runs twice."""

import io
import math
import re
import shutil
import tomllib
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import estune
from estune.cli import run
from estune.errors import InvalidInput
from estune.remote import zenoh
from estune.run.toml_tables import SearchTable
from estune.studies.sweep.cells import expand_cells
from estune.studies.sweep.design import SweepDesign, SweptRig, read_design
from estune.studies.sweep.figures import draw_integral
from estune.studies.sweep.outcome import TRACE, CellOutcome, failed
from estune.studies.sweep.result import SweepResult
from estune.studies.sweep.sweep import show_outcomes
from estune.support.toml_file import validate
from estune.tuners import DEFAULT_TUNER
from tests import support_sweep
from tests.support_rigs import ScriptedRig

SMALL = {
    "lengths_m": [0.5, 0.9, 1.4],
    "tensions_N": [15.0, 25.0],
    "rigs": ["plants:reference_reel"],
    "tuners": ["least_squares_gradient"],
    "trials": 12,
    "repeats": 2,
}


def run_sweep(folder: Path, design=SMALL, **options) -> SweepResult:
    return estune.sweep(design, folder=folder, **{"jobs": 1, "watch": None, **options})


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The result of the small sweep."""
    return run_sweep(tmp_path_factory.mktemp("small"))


def alike(one: CellOutcome, other: CellOutcome) -> bool:
    """Whether two outcomes are equal except for their durations."""
    rest = [replace(o, trace_source=np.empty(0), duration_s=0.0) for o in (one, other)]
    return repr(rest[0]) == repr(rest[1]) and np.array_equal(one.trace, other.trace)


def test_design_reports_all_faults_with_their_keys():
    wrong = {
        "lengths_m": [0.5, 0.5, 1.0],
        "tensions_N": [25.0, 15.0],
        "tuners": ["otisx"],
        "seeds": 0,
        "rigs": ["plants:reference_reel", {"target": "reel.toml", "cable_length_m": 0.8}],
        "start": {"Q": 1.0},
        "trails": 100,
    }
    with pytest.raises(InvalidInput) as caught:
        validate(SweepDesign, wrong, "sweep.toml")
    for words in (
        "sweep.toml: tuners.0: there is no tuner 'otisx'",
        "seeds: must be greater than or equal to 1",
        "rigs.1: cable_length_m: reel.toml is a model",
        "trails: there is no such key; did you mean trials?",
    ):
        assert words in str(caught.value).replace("rigs.1.cable", "rigs.1: cable"), words
    right = {**wrong, "tuners": ["otis"], "seeds": 1, "rigs": wrong["rigs"][:1]}
    right.pop("trails")
    with pytest.raises(InvalidInput) as caught:
        read_design(right)
    for words in (
        "lengths_m: 0.5 m appears more than once",
        "tensions_N: 15 N comes after 25 N; give them in ascending order",
        "start.Q: there is no such gain; the gains are P, I, D, setpoint_filter_s",
    ):
        assert words in str(caught.value), words


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"lengths_m": [0.8]}, "0.8 m is one length only, which gives no law"),
        ({"lengths_m": []}, "plants:reference_reel is a model, to be simulated at each"),
        ({"step": {"preload_N": 10.0}}, "in a sweep that is tensions_N"),
        ({"tensions_N": [35.0], "step": {"step_N": 10.0}}, "setpoint 45 is outside the rig's"),
        ({"tensions_N": [45.0]}, "it must lie from 5 to 40 N"),
        ({"rigs": ["plants:no_reel"]}, "plants has no 'no_reel'"),
        (
            {"rigs": ["plants:unloaded_reel"]},
            r"no cable_length_m; .* \(5 more places do not fit\)",
        ),
        ({"bounds": {"P": [1.0, 2.0]}}, "P"),
    ],
)
def test_expand_cells_refuses_designs_that_do_not_fit(changed, words):
    with pytest.raises(InvalidInput, match=words):
        expand_cells(read_design({**SMALL, **changed}))


def test_dry_run_shows_the_trials_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sweep.toml").write_text(
        'lengths_m = [0.5, 1.4]\nrigs = ["plants:reference_reel"]\nseeds = 2\ntrials = 30\n'
    )
    assert run(["sweep", "sweep.toml", "--dry-run"]) == 0
    text = capsys.readouterr().out
    most = expand_cells(read_design("sweep.toml"))[0].most_trials
    assert "15 to 25 N" in text
    assert f"at most {4 * most}, each within its rig's limits" in text
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.toml"]


@pytest.mark.slow
def test_processes_give_equal_outcomes_and_a_second_call_runs_nothing(small, tmp_path):
    many = run_sweep(tmp_path / "many", jobs=2)
    assert len(small.outcomes) == 6
    assert all(map(alike, small.outcomes, many.outcomes))
    outcomes: list[CellOutcome] = []
    again = run_sweep(tmp_path / "many", watch=outcomes.append)
    assert not outcomes
    assert all(map(alike, small.outcomes, again.outcomes))
    # More seeds add cells; the finished ones stay.
    more = run_sweep(tmp_path / "many", {**SMALL, "seeds": 2}, watch=outcomes.append)
    assert len(more.outcomes) == 12
    assert sorted(o.cell.seed for o in outcomes) == [1] * 6


def test_noise_seed_depends_on_the_cell_but_not_its_tuner():
    both = {**SMALL, "tuners": ["least_squares_gradient", "otis"], "seeds": 2}
    cells = expand_cells(read_design(both))
    seeds = [cell.noise_seed for cell in cells]
    assert len(cells) == 2 * len(set(seeds)) == len({cell.key for cell in cells})


def test_cell_key_depends_on_the_model_but_not_its_folder(tmp_path):
    def keys(folder: Path, model: str) -> list[str]:
        folder.mkdir(exist_ok=True)
        (folder / "reel.toml").write_text(model)
        (folder / "sweep.toml").write_text('lengths_m = [0.5, 1.4]\nrigs = ["reel.toml"]\n')
        return [cell.key for cell in expand_cells(read_design(folder / "sweep.toml"))]

    here = keys(tmp_path / "here", "[reel]\n")
    assert here == keys(tmp_path / "there", "[reel]\n")
    assert not set(here) & set(keys(tmp_path / "here", "[reel]\ngauge_noise_N = 0.1\n"))


def test_stored_sweep_of_version_0_1_0_continues_without_reruns(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.studies.sweep.cells.version", lambda _: "0.1.0")
    shutil.copy(Path(__file__).parent / "assets" / "sweep_0_1_0.sqlite", tmp_path / "sweep.sqlite")
    design = {
        "lengths_m": [0.5, 1.4],
        "rigs": ["tests.support_sweep:fragile"],
        "tuners": ["safe_bayesian"],
        "trials": 4,
        "repeats": 2,
    }
    rerun: list[CellOutcome] = []
    outcomes = run_sweep(tmp_path, design, watch=rerun.append).outcomes
    assert not rerun
    assert [o.cell.key for o in outcomes] == ["1e90e59c1f094e9fac19", "be5ab2dc0de464e5f827"]
    assert [o.trace.shape for o in outcomes] == [(26, 7), (26, 7)]


def test_frame_is_tidy_and_dataset_has_the_design_dimensions(small, tmp_path):
    frame = small.to_frame()
    assert frame.shape[0] == 6
    assert not frame.duplicated(["length_m", "tension_N", "tuner", "seed", "rig"]).any()
    dataset = small.to_xarray()
    assert dict(dataset.sizes) == {"length": 3, "tension": 2, "tuner": 1, "seed": 1, "rig": 1}
    there = {"length": 0.9, "tension": 25.0, "seed": 0}
    row = frame[(frame["length_m"] == 0.9) & (frame["tension_N"] == 25.0)].iloc[0]
    assert float(dataset["I"].sel(there).item()) == row["I"]
    assert dataset["I"].attrs["units"] == "1/s"
    small.to_parquet(tmp_path / "cells.parquet")
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "cells.parquet"), frame)


def test_failed_cell_is_stored_and_tried_again(tmp_path):
    design = {**SMALL, "rigs": ["tests.support_sweep:fragile"], "tensions_N": []}
    support_sweep.broken_at_m.add(0.9)
    try:
        first = run_sweep(tmp_path, design)
    finally:
        support_sweep.broken_at_m.clear()
    (broken,) = first.failed
    assert broken.cell.length_m == 0.9
    assert broken.message == "ZeroDivisionError: no answer to 0"
    assert math.isnan(first.to_frame().set_index("length_m").loc[0.9, "P"])
    outcomes: list[CellOutcome] = []
    second = run_sweep(tmp_path, design, watch=outcomes.append)
    assert [o.cell.length_m for o in outcomes] == [0.9]
    assert not second.failed


def test_law_excludes_and_lists_unsafe_and_unconverged_tunings(small, tmp_path):
    assert all("the search did not converge" in o.excluded for o in small.excluded)
    assert len(small.excluded) == 6
    with pytest.raises(InvalidInput, match=r"too few for a law over length.*: 6 not converged"):
        small.law()
    reason = small.series[0].law_or_reason()
    assert (
        "6 of 6 tunings ended without an estimate" in reason or "remaining improvement" in reason
    )
    assert 'give them more trials (trials = 24 instead of 12), or tuners = ["' in reason
    unsafe = run_sweep(tmp_path / "unsafe", {**SMALL, "eta_max": 1.0})
    assert all("the start gains" in o.excluded for o in unsafe.outcomes)
    assert not any(o.safe for o in unsafe.outcomes)


def test_integral_gain_is_drawn_from_its_initial_value_over_searches_of_few_trials(tmp_path):
    swept = run_sweep(tmp_path / "short", {**SMALL, "trials": 4})
    (ax,) = draw_integral(swept.outcomes).axes
    assert [[*line.get_xdata()] for line in ax.lines] == [[0, 1, 2, 3, 4]] * len(ax.lines)
    starts = {outcome.trace[0, TRACE.index("I")] for outcome in swept.outcomes}
    assert {line.get_ydata()[0] for line in ax.lines} == starts
    assert len(ax.lines) == len(SMALL["lengths_m"])


@pytest.mark.usefixtures("undrawn")
def test_sweep_command_writes_laws_report_and_cells(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sweep.toml").write_text(
        'lengths_m = [0.5, 0.8, 1.1, 1.4]\nrigs = ["plants:reference_reel"]\ntrials = 12\n'
    )
    assert run(["sweep", "sweep.toml", "--quiet", "--jobs", "1"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "I falls by" in text
    folder = Path("sweeps/sweep")
    page = (folder / "report.html").read_text()
    assert page.count("<img") == 6  # costs, integral gain, and the law of each of four gains
    assert "Fig. 14. I =" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    cells = pd.read_csv(folder / "cells.csv")
    assert len(cells) == 4
    assert cells["I_log_error"].between(0.0, 1.0, inclusive="neither").all()
    assert '"schedule"' in (folder / "law.json").read_text()


def test_rigs_are_tuned_in_parallel_and_resume_after_an_interrupt(tmp_path):
    rigs = [ScriptedRig(name=f"r{n}", cable_length_m=0.5 + 0.4 * n) for n in range(2)]
    with ExitStack() as stack:
        servers = [
            stack.enter_context(zenoh.serve(rig, "tcp/127.0.0.1:0", ledger=tmp_path / rig_name))
            for rig, rig_name in zip(rigs, ("one", "other"), strict=True)
        ]
        design = {
            "rigs": [{"target": s.endpoint, "name": f"reel {n}"} for n, s in enumerate(servers)],
            "trials": 12,
            "repeats": 2,
            "seeds": 2,
            "tuners": ["least_squares_gradient"],
        }

        def stop(_: CellOutcome) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            run_sweep(tmp_path / "sweep", design, watch=stop)
        result = run_sweep(tmp_path / "sweep", design)
    assert not result.failed
    assert sorted({o.cell.length_m for o in result.outcomes}) == [0.5, 0.9]
    for rig, of_rig in zip(rigs, (result.outcomes[:2], result.outcomes[2:]), strict=True):
        trial_ids = [request.trial_id for request in rig.requests]
        assert len(trial_ids) == len(
            set(trial_ids)
        )  # no trial twice, before and after the interrupt
        reported = sum(len(o.trace) for o in of_rig)
        assert len(trial_ids) - reported <= 1  # at most the interrupted one


@pytest.mark.parametrize(
    ("length", "entry", "lengths", "words"),
    [
        (1.6, {}, [0.5, 1.4], "its cable is 1.6 m, outside the sweep's range of 0.5 to 1.4 m"),
        (None, {}, [0.5, 1.4], "it does not state its cable length; give cable_length_m"),
        (0.8, {"cable_length_m": 0.9}, [0.5, 1.4], "its description has a cable of 0.8 m"),
        (0.8, {}, [], "one length only, which gives no law over length"),
    ],
)
def test_rig_with_wrong_or_unknown_length_is_refused(tmp_path, length, entry, lengths, words):
    rig = ScriptedRig(cable_length_m=length)
    with zenoh.serve(rig, "tcp/127.0.0.1:0", ledger=tmp_path / "ledger") as server:
        design = {"rigs": [{"target": server.endpoint, **entry}], "lengths_m": lengths}
        with pytest.raises(InvalidInput, match=words):
            expand_cells(read_design(design))
    assert not rig.requests


def test_sweep_documentation_lists_every_key_and_valid_examples():
    text = (Path(__file__).parents[1] / "docs" / "how-to" / "sweep.md").read_text()
    rows = dict(re.findall(r"^\| `([\w.]+)` \|([^|]*)\|", text, re.MULTILINE))
    tables = {"": SweepDesign, "rigs.": SweptRig}
    keys = {prefix + key for prefix, table in tables.items() for key in table.model_fields}
    assert set(rows) == keys - {"step", "cost"} - set(SearchTable.model_fields)
    for prefix, table in tables.items():
        for key, field in table.model_fields.items():
            documented = rows.get(prefix + key, "").strip().strip("`")
            plain = isinstance(field.default, str | int | float) and field.default != ""
            if plain and key not in SearchTable.model_fields:
                assert documented == str(field.default), key
    examples = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert len(examples) == 2
    for example in examples:
        assert validate(SweepDesign, tomllib.loads(example), "docs/how-to/sweep.md").rigs
    assert rows["tuners"].strip() == f'`["{DEFAULT_TUNER}"]`'


def test_plain_progress_counts_finished_and_failed_cells(tmp_path):
    stream = io.StringIO()
    outcome = run_sweep(tmp_path, {**SMALL, "lengths_m": [0.5, 1.4], "tensions_N": []}).outcomes[0]
    with show_outcomes(cells=5, missing=3, stream=stream) as saw:
        saw(outcome)
        saw(failed(outcome.cell, "the cable is off"))
        saw(outcome)
    lines = stream.getvalue().splitlines()
    assert lines[0].startswith("3 of 5 cells  ")
    assert " left  plants:reference_reel at 0.5 m, 15 N" in lines[0]
    assert lines[1].startswith("4 of 5 cells, 1 failed  ")
    assert lines[2].startswith("5 of 5 cells, 1 failed  plants:reference_reel")
