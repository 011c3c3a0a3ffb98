"""docs/how-to/hardware.md: its packets, drivers, keys and TOML."""

import re
import tomllib
from pathlib import Path

from estune.hardware.drivers.serial_board import ANSWER, CHECKSUM, REQUEST
from estune.hardware.tables import (
    GuardTable,
    LimitsTable,
    MotionTable,
    RealTimeTable,
    SafeTable,
)
from estune.reel.guard import Reason
from estune.support.plugins import plugins

PAGE = (Path(__file__).parents[1] / "docs" / "how-to" / "hardware.md").read_text()


def test_page_states_the_size_of_the_serial_boards_packets():
    for who, packet in (("board", REQUEST), ("computer", ANSWER)):
        assert f"to the {who}, {packet.size + CHECKSUM.size} bytes" in PAGE


def test_page_names_the_installed_drivers():
    named = set(re.findall(r"^\| (?:gauge )?`([-\w]+)`", PAGE, re.MULTILINE))
    assert named >= plugins("estune.drivers").keys()


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
