"""What commands do not import, so that they answer at once."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = """
import contextlib, io, json, sys
from estune.cli import run
with contextlib.redirect_stdout(io.StringIO()):
    code = run(sys.argv[1:])
print(json.dumps([code, sorted({name.partition(".")[0] for name in sys.modules})]))
"""
ALWAYS = {"casadi", "control", "joblib", "matplotlib", "pandas", "pyarrow", "starlette", "xarray"}
NOT_LOADED = {
    ("--version",): ALWAYS | {"markdown_it", "numpy", "pydantic", "scipy", "sqlite3", "zenoh"},
    ("--help",): ALWAYS | {"markdown_it", "numpy", "pydantic", "scipy", "sqlite3", "zenoh"},
    ("list", "--folder", "."): ALWAYS | {"numpy", "pydantic", "scipy", "zenoh"},
    ("show", "one", "--folder", "."): ALWAYS | {"zenoh"},
    ("apply", "one", "tcp/127.0.0.1", "--folder", "."): ALWAYS,
}
"""Libraries that a command has no use for; each takes 50 ms to 1 s to import."""


@pytest.mark.parametrize("command", NOT_LOADED, ids=lambda command: command[0])
def test_command_imports_no_library_that_it_does_not_use(command, arithmetic_run):
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS, *command],
        cwd=arithmetic_run.parent,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
        check=True,
    )
    code, loaded = json.loads(done.stdout)
    assert (code == 0) == (command[0] != "apply"), done.stderr  # its endpoint has no port
    assert NOT_LOADED[command] & {*loaded} == set()
