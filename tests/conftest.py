"""Settings of all tests, their distribution over processes, commands run in a test's process."""

import os
import signal
import sys
from pathlib import Path

import pytest
from hypothesis import settings
from xdist.scheduler import LoadScopeScheduling

import estune
from estune.cli import run
from tests.support_runs import ArithmeticRig

WORKERS = 3
"""One more than the two cores CI has, as many tests wait for other processes."""

INDEPENDENT = (
    "test_experiments",
    "test_improve",
    "test_scaled_units",
    "test_journal",
    "test_explain_plants",
    "test_explain_friction",
)
"""Files of long tests without shared fixtures, which may run in different processes."""

LONGEST = (
    "test_live_page",
    "test_page_path",
    "test_docs",
    "test_daemon_faults",
    "test_sweep_durability",
    "test_bus",
    "test_hidden_block",
    "test_cli",
    "examples",
    "test_hardware",
    "test_daemon_remedies",
    "test_notebooks",
    "test_rig_link",
    "test_explain",
    "test_sweep",
    "test_tuning_page",
    "test_security",
    "test_service_records",
    "test_model_based",
    "test_trial_board",
    "test_robustness",
    "test_daemon_margins",
    "test_tuners",
    "test_explain_report",
    "test_friction",
    "first-tuning",
    "test_drivers",
    "test_daemon",
    "test_force_bench",
    "test_explain_page",
    "test_improve_trials",
    *INDEPENDENT,
    "test_effects",
    "test_explain_cli",
    "test_paper",
    "test_finding",
    "test_hidden_effects",
    "test_limitations",
    "test_service_friction",
    "test_match",
    "logs",
    "own-driver",
    "test_compensation",
    "test_effect_physics",
    "test_bridges",
    "test_setpoints",
)
"""Files that start first, so that no process is left with a long one at the end."""

if sys.dont_write_bytecode:
    # Else each process of the tests compiles all modules anew: 15 s of CPU to collect the tests,
    # and 7 s with compiled ones; hundreds of processes start a rig or a command.
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(Path(sys.prefix) / "pycache")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix

# Equal examples on every machine, however slow it is.
settings.register_profile("estune", derandomize=True, deadline=None)
settings.load_profile("estune")


class FileScheduling(LoadScopeScheduling):
    """Runs a file in one process, as its tests share rigs and daemons, unless independent."""

    def _split_scope(self, nodeid):
        file = nodeid.partition("::")[0]
        return nodeid if Path(file).stem in INDEPENDENT else file


def pytest_xdist_auto_num_workers(config):
    """Workers for the whole suite; files named on the command line run in this process."""
    return WORKERS if config.args_source is config.ArgsSource.TESTPATHS else 0


def pytest_xdist_make_scheduler(config, log):
    return FileScheduling(config, log)


def pytest_collection_modifyitems(items):
    rank = {name: n for n, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="module")
def chromium():
    """A browser for the pages of a file."""
    from tests.support_browser import browser  # noqa: PLC0415  slow to import

    with browser() as made:
        yield made


@pytest.fixture
def here(monkeypatch, capsys):
    """Runs a command in this process, and gives what it printed."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def succeed(*arguments):
        assert run(list(map(str, arguments))) == 0
        return capsys.readouterr().out

    return succeed


@pytest.fixture
def arithmetic_run(tmp_path):
    estune.tune(ArithmeticRig(), trials=1, repeats=1, folder=tmp_path, run="one", watch=None)
    return tmp_path / "one"


@pytest.fixture
def refused(monkeypatch, capsys):
    """Runs a command that is to be refused, and gives its exit code and its one line."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.syspath_prepend(Path(__file__).parents[1])

    def refuse(*arguments):
        code = run(list(map(str, arguments)))
        said = capsys.readouterr()
        assert said.err.count("\n") == 1, said.err
        assert said.err.startswith("estune: ")
        return code, said.err

    return refuse
