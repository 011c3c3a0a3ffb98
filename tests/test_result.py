"""Results of runs: OptimizeResult, frame, table, figures and ending."""

import math
import pickle
from dataclasses import replace
from xml.etree import ElementTree as ET

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.optimize import OptimizeResult

import estune
from estune.core.gains import Gains
from estune.errors import JournalError
from estune.run.ending import RunEnding
from estune.run.loop import Stopped
from estune.run.phase import Phase
from estune.run.results import figures
from estune.support import plot_style
from estune.trial import LinearModel, Outcome
from estune.trial.scoring import cost_of, metrics_of
from tests.support_runs import START, ArithmeticRig


class Unlucky(ArithmeticRig):
    """Rig that diverges in some trials and is interrupted before one."""

    def __init__(self, *, diverging=(), stop_before=None, **changes):
        super().__init__(**changes)
        self.diverging, self.stop_before = diverging, stop_before

    def run(self, request):
        if request.number == self.stop_before:
            raise KeyboardInterrupt
        record = super().run(request)
        if request.number in self.diverging:
            return replace(record, outcome=Outcome.DIVERGED, reason="left the range")
        return record


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    rig = Unlucky(diverging=(9, 12))
    return estune.tune(rig, trials=40, folder=folder, run="run", watch=None)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    with pytest.raises(Stopped):
        estune.tune(Unlucky(stop_before=7), folder=folder, run="cut", watch=None)
    return estune.load(folder / "cut")


@pytest.fixture(scope="module")
def unimproved():
    rig = ArithmeticRig(gains=ArithmeticRig.best)
    return estune.tune(rig, trials=6, journal=False, watch=None)


def test_result_is_an_optimize_result(tuned):
    assert isinstance(tuned, OptimizeResult)
    assert tuned.success
    assert tuned["status"] == tuned.status == 5  # its logged effort shows no limits
    assert Gains(*tuned.x) == tuned.gains != START == tuned.start_gains
    assert tuned.fun == tuned.verdict.cost < tuned.verdict.start_cost
    assert (tuned.nit, tuned.nfev) == (40, len(tuned.entries))


def test_dir_of_result_lists_fields_and_methods(tuned):
    assert {"gains", "x", "to_frame", "figure", "tuned"} <= set(dir(tuned))
    assert str(tuned) == repr(tuned)


def test_result_survives_pickling(tuned):
    again = pickle.loads(pickle.dumps(tuned))  # noqa: S301  our own
    assert repr(again) == repr(tuned)
    assert again.to_frame().equals(tuned.to_frame())


def test_frame_has_a_row_per_trial_and_monotone_best_cost(tuned):
    frame = tuned.to_frame()
    assert list(frame["number"]) == list(range(tuned.nfev))
    assert list(frame["trial_id"]) == [e.trial_id for e in tuned.entries]
    assert list(frame.loc[frame["unsafe"], "number"]) == [9, 12]
    # The effort of this rig does not move the measurement, so that no excitation would tell more.
    assert set(frame["phase"]) == set(map(str, Phase)) - {"excite"}
    best = frame["best_cost"].to_numpy()
    assert (np.diff(best) <= 0.0).all()
    assert best[-1] == frame.loc[~frame["unsafe"], "cost"].min()
    row = frame.iloc[5]
    assert Gains(row.P, row.I, row.D, row.setpoint_filter_s) == tuned.entries[5].gains


def test_record_is_read_by_trial_number(tuned):
    record = tuned.record(5)
    assert record.gains == tuned.entries[5].gains
    cost = cost_of(record, tuned.plan.step, tuned.plan.cost, tuned.rig.newtons_per_ampere)
    assert cost == tuned.entries[5].cost
    with pytest.raises(JournalError, match="no trial 999"):
        tuned.record(999)


def test_run_without_journal_keeps_the_records_it_plots(unimproved):
    assert unimproved.record(0).trial_id == unimproved.entries[0].trial_id
    with pytest.raises(JournalError, match="journal=True"):
        unimproved.record(4)


def test_table_shows_first_and_last_record_of_the_gains(tuned):
    start, tuned_record = tuned.start.record, tuned.tuned.record
    assert start.trial_id == tuned.entries[0].trial_id
    same = [
        e.trial_id
        for e in tuned.entries
        if e.phase is Phase.CONFIRM and e.gains == tuned_record.gains
    ]
    assert tuned_record.gains == tuned.gains
    assert tuned_record.trial_id == same[-1]
    metrics = metrics_of(tuned_record, tuned.plan.step)
    values = {row.label: row.tuned for row in tuned.rows()}
    assert values["rise time"] == f"{metrics.rise_time_s * 1e3:.3g} ms"


@pytest.mark.parametrize(
    ("model", "start"),
    [
        (None, ("-", "-")),
        # An integrator under P > 0 and I > 0 is stable.
        (LinearModel(((0.0,),), (1.0,), (1.0,)), None),
        (LinearModel(((500.0,),), (1.0,), (1.0,)), ("unstable", "unstable")),
    ],
    ids=["no model", "stable", "unstable"],
)
def test_margins_are_of_the_rigs_model_or_missing(model, start):
    rig = ArithmeticRig(linear_model=model)
    result = estune.tune(rig, trials=1, repeats=1, journal=False, watch=None)
    values = {row.label: row.start for row in result.rows()}
    margins = (values["gain margin"], values["phase margin"])
    if start is None:
        on_model = result.start.margins
        gain_dB = 20.0 * math.log10(on_model.gain_margin)
        start = (f"{gain_dB:.1f} dB", f"{on_model.phase_margin_deg:.0f}°")
    assert margins == start


@pytest.mark.parametrize("kind", ["stopped", "unimproved"])
def test_result_without_improvement_shows_no_tuned_column(kind, request, tuned):
    result = request.getfixturevalue(kind)
    assert not result.success
    assert result.status != 0
    assert result.gains == result.start_gains
    assert result.ending in (RunEnding.STOPPED, RunEnding.NO_IMPROVEMENT)
    for text in (repr(result), result._repr_html_()):
        assert result.ending.upper() in text
        assert "TUNED" not in text
    assert "tuned" not in repr(result)
    assert all(row.tuned == "" for row in result.rows())
    assert not result.findings
    assert repr(tuned).startswith("TUNED")


def test_unsafe_start_is_an_ending_of_its_own(tmp_path):
    with pytest.raises(estune.EstuneError, match="unsafe"):
        estune.tune(Unlucky(diverging=(0,)), folder=tmp_path, run="unsafe", watch=None)
    result = estune.load(tmp_path / "unsafe")
    assert result.ending is RunEnding.UNSAFE_START
    assert "UNSAFE START" in repr(result)
    assert result.figure()


def test_html_is_well_formed_and_escaped(tuned):
    rig = ArithmeticRig(name="<script>&")
    strange = estune.tune(rig, trials=1, repeats=1, journal=False, watch=None)
    html = strange._repr_html_()
    ET.fromstring(html)  # noqa: S314  our own text
    assert "<script>" not in html
    assert "&lt;script&gt;&amp;" in html
    assert tuned._repr_html_().count("<svg") == 1


def test_plots_return_given_axes_with_units_without_pyplot(tuned):
    ax = plot_style.new_axes()
    assert tuned.plot_cost(ax) is ax
    labels = [tuned.plot_step().get_xlabel(), tuned.plot_step().get_ylabel()]
    assert labels == ["time from the step, s", "tension, N"]
    assert tuned.plot_gains().get_yscale() == "log"
    assert tuned.plot_cost()._repr_png_().startswith(b"\x89PNG")
    assert plt.get_fignums() == []
    assert plot_style.to_png(tuned.figure()).startswith(b"\x89PNG")


def test_plot_marks_unsafe_trials_without_scaling_to_them(tuned):
    ax = tuned.plot_cost()
    crosses = next(line for line in ax.lines if line.get_label() == "unsafe")
    assert list(crosses.get_xdata()) == [9, 12]
    assert ax.get_ylim()[1] < 2.0 * tuned.to_frame().loc[~tuned.to_frame()["unsafe"], "cost"].max()


def test_cost_axis_is_logarithmic_only_over_a_decade(tuned):
    trials = tuned.columns()
    narrow = figures.draw_cost(plot_style.new_axes(), trials, 1.0, math.inf)
    trials["cost"][trials["number"] == 4] = 1000.0
    wide = figures.draw_cost(plot_style.new_axes(), trials, 1.0, math.inf)
    assert (narrow.get_yscale(), wide.get_yscale()) == ("linear", "log")


def test_run_of_one_trial_or_none_can_be_drawn(tmp_path):
    for stop_before in (0, 1):
        rig = Unlucky(stop_before=stop_before)
        with pytest.raises(Stopped):
            estune.tune(rig, folder=tmp_path, run=f"run{stop_before}", watch=None)
        result = estune.load(tmp_path / f"run{stop_before}")
        assert result.nfev == stop_before
        assert plot_style.to_png(result.figure())
        assert "STOPPED" in repr(result)


def test_result_is_equal_from_memory_and_disk(tuned):
    assert repr(estune.load(tuned.folder)) == repr(tuned)
