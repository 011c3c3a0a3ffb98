"""Files of every version are opened by this one; see docs/how-to/upgrade.md."""

import json
import shutil
from pathlib import Path

import pytest

import estune
from estune import api
from estune.daemon.store import DaemonStore
from estune.errors import InvalidInput
from estune.hardware import read_config
from estune.hardware.schedule_file import read_schedule
from estune.remote.ledger import LEDGER, FileLedger
from estune.remote.state_machine.trials import TrialState
from estune.studies.sweep.sweep import sweep
from estune.support.sqlite import SqliteFile
from plants.models.model_file import load_model
from tests.stored_formats import DESIGN, MODEL, ROOT, SCHEDULE
from tests.support_runs import ArithmeticRig

VERSIONS = sorted(path.name for path in ROOT.iterdir())


@pytest.fixture(params=VERSIONS)
def stored(request, tmp_path):
    """Files of one version, copied."""
    return Path(shutil.copytree(ROOT / request.param, tmp_path / request.param))


def test_files_of_this_version_are_kept():
    assert ".".join(estune.__version__.split(".")[:2]) in {v.rpartition(".")[0] for v in VERSIONS}


def test_run_is_shown_and_continues(stored):
    result = api.load(stored / "run")
    again = api.resume(stored / "run", target=ArithmeticRig(), watch=None)
    assert again.gains == result.gains
    assert len(again.entries) == len(result.entries) > 6


def test_sweep_is_read_and_none_of_its_cells_runs_again(stored):
    cells = []
    result = sweep(DESIGN, folder=stored / "sweep", watch=lambda *cell: cells.append(cell), jobs=1)
    assert len(result.outcomes) == 2
    assert all(outcome.cost > 0.0 for outcome in result.outcomes)
    assert not [cell for cell in cells if "again" in str(cell)]


def test_rig_file_is_read_with_the_values_it_stated(stored):
    rig = read_config(stored / "rig.toml")
    about, plan = rig.describe(), rig.plan()
    assert about.gains.as_tuple() == (0.4, 12.0, 0.01, 0.03)
    assert (about.newtons_per_ampere, about.measurement) == (20.0, "tension, N")
    assert (plan.guard.tension_max_N, plan.guard.gap_s, plan.guard.frozen_s) == (60.0, 0.015, 0.1)
    assert (plan.motion.taut_N, plan.safe.ramp_s) == (2.0, 0.2)


def test_ledger_knows_its_trials(stored):
    with SqliteFile.open_reader(stored / "rig.ledger", LEDGER) as file:
        ids = [row[0] for row in file.rows("SELECT trial_id FROM trial")]
    book = FileLedger(stored / "rig.ledger", "drum")
    assert len(ids) > 6
    assert {book.find(trial_id).state for trial_id in ids} == {TrialState.ENDED}
    book.close()


def test_daemon_knows_original_and_candidate_gains(stored):
    store = DaemonStore.open(stored / "daemon" / "estune-state" / "drum", "drum")
    assert store.fact("rig") == "drum"
    store.close()


def test_model_and_schedule_are_read_back_exactly(stored):
    assert load_model(stored / "model.toml") == MODEL
    assert read_schedule(stored / "schedule.json") == SCHEDULE


def test_text_of_a_later_format_is_refused_with_the_remedy(tmp_path):
    model, schedule = tmp_path / "model.toml", tmp_path / "schedule.json"
    model.write_text("format = 2\n[reel]\n")
    schedule.write_text(json.dumps({**SCHEDULE.as_dict(), "format": 2}))
    for read in (lambda: load_model(model), lambda: read_schedule(schedule)):
        with pytest.raises(InvalidInput, match=r"format 2.*or a newer one"):
            read()
