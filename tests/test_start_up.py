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
print(json.dumps([code, list(sys.modules)]))
"""
ALWAYS = {"casadi", "control", "jinja2", "joblib", "markdown_it", "matplotlib", "multiprocessing"}
ALWAYS |= {"pandas", "plants.models", "pyarrow", "scipy.integrate", "scipy.interpolate"}
ALWAYS |= {"scipy.signal", "scipy.stats", "starlette", "uvicorn", "xarray"}
AT_ONCE = ALWAYS | {"asyncio", "estune.api", "numpy", "pydantic", "scipy", "zenoh"}
NOT_LOADED = {
    ("--version",): AT_ONCE | {"docstring_parser", "estune.core", "sqlite3"},
    ("--help",): AT_ONCE | {"estune.core", "sqlite3"},
    ("list", "--folder", "."): AT_ONCE | {"docstring_parser"},
    ("show", "one", "--folder", "."): ALWAYS | {"asyncio", "estune.proof", "zenoh"},
    ("apply", "one", "tcp/127.0.0.1", "--folder", "."): ALWAYS,
    # What holds up an emergency stop.
    ("estop", "tcp/127.0.0.1"): ALWAYS
    | {"estune.api", "estune.loop_model", "estune.run", "scipy"},
}
"""Modules that a command has no use for; a library takes 50 ms to 1 s to import."""


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
    reached = command[0] not in ("apply", "estop")  # their endpoint has no port
    assert (code == 0) == reached, done.stderr
    assert NOT_LOADED[command] & {*loaded} == set()
