"""docs/hardware.md: its driver, run against an emulated serial board, its keys and its TOML."""

import os
import re
import struct
import threading
import time
import tomllib
import tty
from pathlib import Path

import pytest

import plants
from estune.errors import RigError
from estune.hardware import HardwareRig
from estune.hardware.tables import (
    GuardTable,
    LimitsTable,
    MotionTable,
    RealTimeTable,
    SafeTable,
)
from estune.reel.guard import Reason
from estune.trial import Outcome, TrialRequest
from plants.emulator.board import Board, Electronics
from tests.support_hardware import quick

PAGE = (Path(__file__).parents[1] / "docs" / "hardware.md").read_text()
COMMAND, ANSWER = struct.Struct("<ch"), struct.Struct("<iq")
BUSY_S = 3.0
"""Scheduling delay, s, that a busy machine may impose on the loop or the board."""


@pytest.fixture
def serial_board(tmp_path, monkeypatch):
    """Writes the page's driver to a folder on the import path."""
    (text,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "serial_board.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "serial_board:SerialBoard"


@pytest.fixture
def port():
    """Serial port connected to the emulated reel."""
    ours, theirs = os.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    board = Board(plants.reference_reel(), Electronics(watchdog_s=BUSY_S), 1, time.monotonic())
    over = threading.Event()

    def serve():
        data = b""
        while not over.is_set():
            try:
                data += os.read(ours, 64)
            except OSError:  # the other end is closed
                return
            now = time.monotonic()
            while len(data) >= COMMAND.size:
                (verb, number), data = COMMAND.unpack_from(data), data[COMMAND.size :]
                if verb == b"r":
                    os.write(ours, ANSWER.pack(*board.read(now)))
                elif verb == b"w":
                    board.write(now, number)
                else:
                    board.power(now, on=verb == b"e")

    thread = threading.Thread(target=serve)
    thread.start()
    yield os.ttyname(theirs)
    over.set()
    os.close(theirs)
    thread.join()
    os.close(ours)


def test_driver_on_the_page_runs_a_trial(serial_board, port):
    settings = {"port": port, "answer_within_s": BUSY_S}
    patient = {f"guard__{limit}": BUSY_S for limit in ("gap_s", "heartbeat_s", "frozen_s")}
    driver = {"driver__use": serial_board, "driver__settings": settings}
    with HardwareRig(quick(**driver, **patient)) as rig:
        description = rig.describe()
        record = rig.run(TrialRequest("page", 0, description.gains, description.step))
        assert record.outcome is Outcome.DONE, record.reason
        assert record.tension_N[-1] > record.tension_N[0]


def test_driver_on_the_page_reports_a_missing_board(serial_board, tmp_path):
    settings = {"port": str(tmp_path / "none")}
    with pytest.raises(RigError, match=r"no board at .*none"):
        HardwareRig(quick(driver__use=serial_board, driver__settings=settings))


def test_page_names_existing_keys_and_all_guard_reasons():
    tables = {
        "guard": GuardTable,
        "limits": LimitsTable,
        "motion": MotionTable,
        "real_time": RealTimeTable,
        "safe": SafeTable,
    }
    named = [pair for pair in re.findall(r"`(\w+)\.(\w+)`", PAGE) if pair[0] in tables]
    assert len(named) >= 4
    for table, name in named:
        assert name in tables[table].model_fields
    rows = PAGE[PAGE.index("| reason |") :].lower()
    for reason in Reason:
        assert str(reason) in rows


def test_page_has_valid_toml():
    for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL):
        assert tomllib.loads(text)
