"""What runs without the modules that only Linux, or only Unix, has."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

_WITHOUT = """
import asyncio, importlib.abc, multiprocessing.connection
import os, socket, subprocess, sys, types

class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in {"fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "syslog"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

for name in list(sys.modules):
    if name in {"fcntl", "resource", "termios", "tty", "pty", "pwd", "grp"}:
        del sys.modules[name]
sys.meta_path.insert(0, Hidden())
sys.modules["msvcrt"] = types.SimpleNamespace(LK_NBLCK=2, locking=lambda *_: None)
for name in ("memfd_create", "sched_setscheduler", "sched_getaffinity", "fork", "geteuid"):
    if hasattr(os, name):
        delattr(os, name)
delattr(socket, "AF_CAN")
"""

_LIBRARY = """
sys.path.insert(0, os.getcwd())
import estune, plants
from estune.errors import RigError
from estune.hardware.drivers.can_bus import CanSocket
from estune.hardware.shared_memory import make_file
from estune.studies.sweep.sweep import sweep
from plants.diagnosis import explain
from tests.support_runs import ArithmeticRig
folder = sys.argv[1]
result = estune.tune(ArithmeticRig(), trials=4, folder=folder, run="run", watch=None)
assert estune.load(folder + "/run").gains == result.gains
assert estune.cli.run(["report", folder + "/run"]) == 0
for call in (lambda: make_file(10), lambda: CanSocket("can0", 0, 1)):
    try:
        call()
    except RigError as error:
        print(error)
"""


@pytest.mark.slow
def test_library_and_pages_run_without_the_modules_of_linux(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", f"{_WITHOUT}import estune.cli\n{_LIBRARY}", tmp_path],
        cwd=Path(__file__).parents[1],
        env={**os.environ, "USERNAME": "anna"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "the real-time loop runs on Linux only" in done.stdout
    assert "CAN interfaces are reached on Linux only" in done.stdout
    assert list(tmp_path.glob("run/report.html"))
