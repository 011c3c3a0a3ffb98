"""The daemon's file: its mistakes are reported, and the docs list all of its keys."""

import json
import re
from pathlib import Path

import pytest

from estune.cli import run
from estune.daemon.config import DaemonConfig, read_config
from estune.daemon.events import EventKind
from estune.daemon.faults import FaultCode
from estune.daemon.metrics import METRICS
from estune.errors import InvalidInput
from estune.run.toml_tables import CostTable, SearchTable, StepTable

ROOT = Path(__file__).parents[1]
TABLES = {"step": StepTable, "cost": CostTable, "tuning": SearchTable}

WRONG = """
stat = "x"
stop_within_s = -1.0
[service]
listen = "tcp/0.0.0.0:7450"
[metrics]
http_prot = 9464
[[hook]]
command = []
events = ["driftd"]
[[rig]]
name = "a b"
target = "tcp/127.0.0.1:7447"
acept = "ask"
retry_first_s = 100.0
[rig.tuning]
tuner = "otisx"
trials = 0
bounds = {P = [10, 0.1], Q = [1, 2]}
[rig.watch]
smoothing = 2.0
every = 3600
[rig.step]
step_at_s = 0.4
duration_s = 0.2
[rig.cost]
settling_time_s = nan
"""


def test_read_config_reports_all_mistakes_with_their_places(tmp_path, capsys):
    file = tmp_path / "daemon.toml"
    file.write_text(WRONG)
    assert run(["daemon", str(file)]) == InvalidInput.exit_code
    errors = capsys.readouterr().err
    for words in (
        "stat: there is no such key; did you mean state?",
        "stop_within_s: must be greater than 0",
        "service: listening at tcp/0.0.0.0:7450 would let any machine",
        "metrics.http_prot: there is no such key; did you mean http_port?",
        "hook.0.command: must have at least 1 item",
        "hook.0.events.0: must be 'started', 'found'",
        "rig.0.name: 'a b' may hold only",
        "rig.0.acept: there is no such key; did you mean accept?",
        "rig.0.retry_first_s: 100 is above retry_max_s 60",
        "rig.0.tuning.tuner: there is no tuner 'otisx'",
        "rig.0.tuning.trials: must be greater than or equal to 1",
        "rig.0.tuning.bounds.P: 10 to 0.1 is no range",
        "rig.0.tuning.bounds.Q: no gain",
        "rig.0.watch: smoothing is 2.0; it must be from 0.01 to 1",
        "rig.0.watch.every: there is no such key; did you mean every_s?",
        "rig.0.step: step_at_s: 0.4 is not before the trial's end",
        "rig.0.cost.settling_time_s: must be a finite number",
    ):
        assert words.replace("step: step_at_s", "step.step_at_s") in errors, words


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("tcp/127.0.0.1:99999", "endpoint 'tcp/127.0.0.1:99999' is malformed"),
        ("tcp/127.0.0.1:0", "nothing listens at port 0"),
        ("tcp/999.1.1.1:7447", "999.1.1.1 is no IP address"),
        ("tcp/reel.invalid:7447", "cannot resolve the host name reel.invalid"),
        ("nothing.toml", "there is no such model file"),
        ("nothing", "is neither an endpoint"),
        ("no_module:reel", "there is no module 'no_module'"),
        ("plants:no_reel", "plants has no 'no_reel'"),
        ("plants:reference_reel", ""),
        ("tcp/127.0.0.1:7447", ""),
        ("tcp/[::1]:7447", ""),
    ],
)
def test_check_refuses_targets_that_cannot_exist(target, words, tmp_path, capsys):
    file = tmp_path / "daemon.toml"
    file.write_text(f'[[rig]]\nname = "drum"\ntarget = "{target}"\n')
    code = run(["daemon", "--check", str(file)])
    assert code == (InvalidInput.exit_code if words else 0)
    assert words in capsys.readouterr().err


def test_check_finds_all_mistakes_at_once(tmp_path, capsys):
    file = tmp_path / "daemon.toml"
    (tmp_path / "taken").write_text("")
    file.write_text(
        'state = "taken/state"\nrigs_max = 0\n[service]\nsecurity = "none.toml"\n'
        '[metrics]\nfile = "taken/estune.prom"\n[[hook]]\ncommand = ["/no/such/program"]\n'
        '[[rig]]\nname = "a b"\ntarget = "tcp/127.0.0.1:0"\n[[rig]]\nname = "b"\n'
        'target = "plants:no_such_reel"\nwatch = { evry_s = 3.0 }\n'
    )
    assert run(["daemon", "--check", str(file)]) == InvalidInput.exit_code
    told = capsys.readouterr().err
    for words in (
        *("rigs_max", "name: 'a b'", "did you mean every_s", "none.toml", "/no/such/program"),
        *("port 0", "no_such_reel", "taken/state cannot be written", "metrics: file:"),
    ):
        assert words in told, told


def test_check_refuses_a_router_whose_name_cannot_be_resolved(tmp_path, capsys):
    file, router = tmp_path / "daemon.toml", "tcp/router.invalid:7447"
    rig = '[[rig]]\nname = "drum"\ntarget = "plants:reference_reel"\n'
    file.write_text(f'[service]\nrouters = ["{router}"]\n{rig}')
    assert run(["daemon", "--check", str(file)]) == InvalidInput.exit_code
    assert f"service: routers: {router}: this machine cannot resolve" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [("rig = []", "at least 1 item"), ("rig = 3 x", "no TOML"), ("", "rig: is missing")],
)
def test_read_config_refuses_empty_and_torn_files(text, words, tmp_path):
    (tmp_path / "d.toml").write_text(text)
    with pytest.raises(InvalidInput, match=words):
        read_config(tmp_path / "d.toml")


def test_docs_list_keys_events_and_metrics():
    text = (ROOT / "docs" / "how-to" / "daemon.md").read_text()

    def rows(table, prefix):
        for name, field in table.model_fields.items():
            inner = next(
                (
                    a
                    for a in (field.annotation, *getattr(field.annotation, "__args__", ()))
                    if hasattr(a, "model_fields")
                ),
                None,
            )
            if inner is None:
                yield f"{prefix}{name}", field
            else:
                yield from rows(inner, f"{prefix}{name}.")

    declared = {
        *(f"rig.{name}.{key}" for name, table in TABLES.items() for key in table.model_fields),
    } - {"rig.tuning.repeats"}  # of which the daemon has its own default
    for key, field in rows(DaemonConfig, ""):
        if key in declared:  # docs/reference/settings.md has them
            continue
        row = re.search(rf"^\* `{re.escape(key)}`(?: \((.*?)\))?: ", text, re.MULTILINE)
        assert row, f"{key} is not in docs/how-to/daemon.md"
        if not field.is_required():
            default = (
                field.default.as_posix() if isinstance(field.default, Path) else field.default
            )
            assert (row[1] or "").strip("`") == (
                "" if default in (None, [], {}) else json.dumps(default).strip('"')
            ), key
    for kind in EventKind:
        assert f"`{kind}`" in text
    for fault in FaultCode:
        assert f"\n* `{fault}`: {fault.sentence}\n" in text
    for metric in METRICS:
        assert f"`{metric.name}`" in text
