"""Emulated hardware: a reel in raw counts, in another process and in wall-clock time.

`EmulatedDriver` is a driver for `estune.hardware`; `python -m plants.emulator` is the hardware by
itself, which continues when the program that drives it is killed. `RIG_FILE` is its rig file.
"""

from pathlib import Path

from plants.emulator.driver import EmulatedDriver

RIG_FILE = Path(__file__).with_name("rig.toml")

__all__ = ["RIG_FILE", "EmulatedDriver", "example_rig_file"]


def example_rig_file() -> str:
    """Text of `RIG_FILE`, printed by `estune serve-hardware --example`."""
    return RIG_FILE.read_text()
