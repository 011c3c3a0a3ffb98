"""A reel in raw counts, in another process and in wall-clock time: hardware that cannot break.

`EmulatedDriver` is a driver for `estune.hardware`; `python -m plants.emulator` is the hardware by
itself, which goes on when the program that drives it is killed. `RIG_FILE` is a rig's file for it.
"""

from pathlib import Path

from plants.emulator.driver import EmulatedDriver

RIG_FILE = Path(__file__).with_name("rig.toml")

__all__ = ["RIG_FILE", "EmulatedDriver", "example_rig_file"]


def example_rig_file() -> str:
    """Text of `RIG_FILE`, printed by `estune serve-hardware --example`."""
    return RIG_FILE.read_text()
