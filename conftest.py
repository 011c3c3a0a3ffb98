"""Settings of all tests: lanes, distribution over processes, pages whose blocks are tests."""

import gc
import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

from tests.support_snippets import collected_page

WORKERS = 3
"""One more than the two cores CI has, as tests of the slow lane wait for other processes."""

if sys.dont_write_bytecode:
    # Else each process of the tests compiles all modules anew: 15 s of CPU to collect the tests,
    # and 7 s with compiled ones; hundreds of processes start a rig or a command.
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(Path(sys.prefix) / "pycache")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix

# Journals and ledgers wait until the disk has what they commit: 4 ms each time, and nothing in
# memory. A test of commands over a served daemon takes half the time there, and 0.9 of the CPU.
# Not where it is small, as in containers, or where no library may be loaded from it.
MEMORY, ROOM_bytes = "/dev/shm", 4_000_000_000  # noqa: S108  a folder for temporary files
if (
    Path(MEMORY).is_dir()
    and shutil.disk_usage(MEMORY).free > ROOM_bytes
    and not os.statvfs(MEMORY).f_flag & os.ST_NOEXEC
):
    os.environ.setdefault("TMPDIR", MEMORY)
    tempfile.tempdir = None  # else what was found before stays

# The collector would visit the values of all modules and tests again and again as they grow: to
# collect the tests takes 6.5 s of CPU in each process without it, and 9.5 s with it.
gc.disable()

# As in runs of the product: a second thread of BLAS waits for the first in a loop, which takes a
# fifth of the CPU of tests of fits. Processes of tests inherit it.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

# Equal examples on every machine, however slow it is.
settings.register_profile("estune", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("estune")

pytest_collect_file = collected_page


def _whole(config: pytest.Config) -> bool:
    """Whether no file is named on the command line."""
    return config.args_source is config.ArgsSource.TESTPATHS


def pytest_configure(config: pytest.Config) -> None:
    """Selects the day lane of the whole suite, both lanes of named files, the night by name.

    A file that is named runs whole: else a change of a slow test would seem to pass.
    """
    lane = config.option.markexpr or ("not slow" if _whole(config) else "")
    if "nightly" not in lane:
        lane = f"({lane}) and not nightly" if lane else "not nightly"
    config.option.markexpr = lane


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    """Lets the collector run from here on, and leave out all that exists for good."""
    gc.freeze()
    gc.enable()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Workers for the whole suite; files named on the command line run in this process."""
    return WORKERS if _whole(config) else 0
