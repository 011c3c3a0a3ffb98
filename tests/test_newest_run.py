"""The run that the page of a rig shows, its banner and its form, without a browser."""

import math
from datetime import UTC, datetime, timedelta
from itertools import count

import pytest

from estune import tune
from estune.errors import InvalidInput
from estune.remote.ledger import FileLedger, MemoryLedger
from estune.remote.state_machine.trials import TrialEvent
from estune.run.journal import Journal
from estune.run.phase import Phase
from estune.run.tally import Tally
from estune.trial import Outcome
from estune.web.banner import banner
from estune.web.board import Board
from estune.web.run_folder import RunFolder
from estune.web.run_reader import RunReader
from estune.web.tuning_form import MORE, WORDS, FormFault, expected, form, read_settings
from estune.web.views import NewestRun
from tests.support_runs import ArithmeticRig

NOW = datetime(2026, 5, 4, 12, tzinfo=UTC)
RIG = {"mode": "idle", "sentence": "nothing moves", "holder": "", "latched": "", "trial_id": ""}
STATE = {
    "status": "running",
    "phase": "search",
    "done": 2,
    "left": 117,
    "at_most": True,
    "trial_s": 1.5,
    "unsafe": 0,
    "best": None,
    "ended_at": (NOW - timedelta(seconds=12)).isoformat(),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two runs of one rig, in the order of their names."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("first", "second"):
        tune(ArithmeticRig(), trials=2, run=name, folder=folder, watch=None)
    return folder


def newest(folder, said=("", False), board=None) -> str | None:
    board = board or Board()
    rig = ArithmeticRig().describe().name
    path = NewestRun(board, RunFolder(folder), rig, lambda _: said)()
    return path and path.name


def test_newest_run_is_the_one_with_the_youngest_trial_until_the_rig_names_one(folder):
    assert newest(folder) == "second"
    assert newest(folder, ("first", False)) == "first"
    assert newest(folder, ("first", True)) == "first"


def test_run_under_way_is_shown_before_its_first_trial(folder):
    with Journal.open(folder / "first", write=True) as journal:
        status = journal.fact("status")
        journal.note(status="running")
        try:
            assert newest(folder, ("second", False)) == "first"
        finally:
            journal.note(status=status)


def test_run_elsewhere_is_named_and_the_newest_of_the_folder_stays(folder):
    for said, shown in (("other", "other"), ("try-1", ""), ("second", ""), ("", "")):
        board = Board()
        assert newest(folder, (said, False), board) == "second"
        assert board.get("elsewhere") == shown


def test_run_on_a_model_of_the_same_name_is_no_run_of_the_rig(tmp_path):
    tune("plants:reference_reel", trials=1, repeats=1, run="model", folder=tmp_path, watch=None)
    with Journal.open(tmp_path / "model") as journal:
        rig = journal.fact("rig")["name"]
    assert RunFolder(tmp_path).of_rig(rig) == []


def test_reader_leaves_nothing_of_a_run_when_it_begins_with_another(folder):
    board, runs = Board(), iter([folder / "first", folder / "second", None])
    reader = RunReader(board, lambda: next(runs))
    for name in ("first", "second"):
        reader.read()
        assert board.get("run")["name"] == name
        assert board.get("result")["heading"]
    reader.read()
    assert (board.get("run"), board.get("result"), board.get("curve.start")) == (None,) * 3


def test_follower_that_fails_is_said_on_the_page_of_the_rig():
    values = {"rig": RIG, "fault.run": "the journal is damaged"}
    assert banner("rig", values, {}, NOW) == ("run not shown", "stale", "the journal is damaged")


FINISHED = STATE | {"status": "finished"}
OFFER = {"gains": {"P": 1.0}}
BANNERS = {
    "idle": ({"rig": RIG}, ("idle", "", "nothing moves")),
    "running": (
        {"rig": RIG, "state": STATE},
        ("running", "yes", "2 of at most 119 trials done: search; at most 3 min left"),
    ),
    "tuned": (
        {
            "rig": RIG,
            "state": FINISHED,
            "result": {"ending": "tuned", "good": True, "offer": OFFER},
            "description": {"gains": [2.0]},
        },
        ("tuned", "yes", "12 s ago; its gains are not live"),
    ),
    "a limit broken": (
        {
            "rig": RIG,
            "state": FINISHED,
            "result": {"ending": "tuned, but a limit is broken", "good": False, "offer": None},
        },
        ("a limit is broken", "no", "12 s ago"),
    ),
    "failed": (
        {"rig": RIG, "state": STATE | {"status": "failed: the rig is gone"}},
        ("failed", "no", "12 s ago; the rig is idle now; it ended with: the rig is gone"),
    ),
    "begun": ({"rig": RIG, "begun": {"run": "b", "fault": ""}, "run": {"name": "a"}}, "starting"),
    "not begun": (
        {"rig": RIG, "begun": {"run": "b", "fault": "no such cost"}},
        ("not started", "no", "no such cost"),
    ),
    "stopped": (
        {"rig": RIG | {"latched": "by hand"}, "state": STATE},
        ("emergency stop", "no", "by hand"),
    ),
    "a trial of another": (
        {"rig": RIG | {"mode": "running", "trial_id": "x-00004"}, "elsewhere": "x"},
        "running",
    ),
}


@pytest.mark.parametrize("case", BANNERS)
def test_banner_is_the_state(case):
    values, shown = BANNERS[case]
    found = banner("rig", values, {}, NOW)
    assert (found.word if isinstance(shown, str) else found) == shown


def test_banner_says_which_source_is_silent():
    assert banner("rig", {"rig": RIG}, {"rig": 4.0}, NOW).word == "no link to the rig"
    assert banner("run", {"state": FINISHED}, {"rig": 4.0}, NOW).word == "finished"


def test_tally_of_all_trials_is_that_of_one_after_the_other():
    done, inf = Outcome.DONE, math.inf
    trials = [
        (Phase.BASELINE, Outcome.CANCELLED, math.nan),
        (Phase.BASELINE, done, 2.0),
        (Phase.BASELINE, done, 4.0),
        (Phase.SEARCH, done, 9.0),
        (Phase.SEARCH, done, 9.1),
        (Phase.EXCITE, done, math.nan),
        (Phase.SEARCH, Outcome.DECLINED, math.nan),
        (Phase.CONFIRM, Outcome.GUARD, math.nan),
    ]
    whole = Tally(None).after(trials)
    assert whole == (None, 7, 2, 1, (2.0, 4.0), (2.0, 0))
    one_by_one = Tally(None)
    for trial in trials:
        one_by_one = one_by_one.after([trial])
    assert one_by_one == whole
    assert (Tally(None).eta_max, Tally(5.0).after(trials).unsafe) == (inf, 3)


@pytest.mark.parametrize("kind", ["memory", "file"])
def test_ledger_knows_its_youngest_trial(kind, tmp_path):
    ledger = MemoryLedger() if kind == "memory" else FileLedger(tmp_path / "ledger", "reel")
    try:
        assert ledger.last == ""
        for name in ("a-00000", "b-00000"):
            ledger.note(name, "digest", TrialEvent.SUBMIT)
        assert ledger.last == "b-00000"
    finally:
        ledger.close()


def test_form_has_words_for_every_setting_and_two_open_fields():
    shown = form(None, [])
    names = [field["name"] for group in shown["more"] for field in group["settings"]]
    assert [field["name"] for field in shown["open"]] == ["max_sensitivity", "max_overshoot"]
    assert [field["otherwise"] for field in shown["open"]] == ["1.6", "5"]
    assert set(WORDS) == {*names, "max_sensitivity", "max_overshoot"}
    assert len(MORE) == len(shown["more"])


@pytest.mark.parametrize(
    ("given", "field", "why"),
    [
        ({"trials": "many"}, "trials", "write a whole number, 1 or more instead of 'many'"),
        ({"max_sensitivity": "0.5"}, "max_sensitivity", "write a number, above 1, at most 100"),
        ({"max_overshoot": "500"}, "max_overshoot", "write a number, above 0, at most 100"),
        ({"step_at_s": "2", "duration_s": "1"}, "step_at_s", "not before the trial's end"),
    ],
)
def test_fault_of_a_setting_is_told_by_its_field(given, field, why):
    with pytest.raises(FormFault) as caught:
        read_settings(given)
    assert list(caught.value.fields) == [field]
    assert why in caught.value.fields[field]


def test_settings_of_the_form_are_options_and_a_bare_share_is_in_per_cent():
    given = read_settings({"max_overshoot": "5", "trials": " 8 ", "preset": "itae", "eta_max": ""})
    assert given.options == ("--max-overshoot=5%", "--trials=8", "--cost=itae")
    assert given.search.limits.max_overshoot == 0.05
    rig = ArithmeticRig().describe()
    given.check(rig)
    with pytest.raises(InvalidInput, match="longer than the rig's limit"):
        read_settings({"duration_s": "1e9"}).check(rig)


def test_expected_trials_and_time_are_those_of_earlier_runs_where_there_are_any(folder):
    runs = RunFolder(folder)
    earlier = runs.of_rig(ArithmeticRig().describe().name)
    trials = {run.row()["trials"] for run in earlier}
    for run, took_s in zip(earlier, count(40.0), strict=False):
        run.took_s = took_s
    assert expected(None, earlier).startswith("The last 2 tunings of this rig took")
    assert str(max(trials)) in expected(None, earlier)
    shown = expected({"duration_s": 2.0}, [])
    assert "one takes 2 s here" in shown
