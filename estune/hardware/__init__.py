"""A reel on real hardware: driver, real-time loop in a process of its own, and the rig around it.

::

    HardwareRig  (this process)          loop process                          hardware
      requests, records, heartbeat  ──►  guard ─► PIDF ─► C1 ─► Driver.write ─►  amplifier
               ◄── columns, outcome      C2 ◄── Driver.read ◄────────────────    gauge, encoder

`read_config` reads a rig's file, `HardwareRig` runs it. See docs/hardware.md.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estune.hardware.config import RigConfig, read_config
    from estune.hardware.driver import Driver, Reading
    from estune.hardware.firmware import controller_source
    from estune.hardware.rig import HardwareRig

__all__ = ["Driver", "HardwareRig", "Reading", "RigConfig", "controller_source", "read_config"]

_HOMES = {
    "Driver": "estune.hardware.driver",
    "HardwareRig": "estune.hardware.rig",
    "Reading": "estune.hardware.driver",
    "RigConfig": "estune.hardware.config",
    "controller_source": "estune.hardware.firmware",
    "read_config": "estune.hardware.config",
}


def __getattr__(name: str) -> Any:
    """Loads a public name when it is first used: the loop's process needs few of them."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
