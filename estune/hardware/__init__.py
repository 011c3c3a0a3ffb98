"""A reel on real hardware: driver, real-time loop in a process of its own, and the rig around it.

::

    HardwareRig  (this process)          loop process                          hardware
      requests, records, heartbeat  ──►  guard ─► PIDF ─► C1 ─► Driver.write ─►  amplifier
               ◄── columns, outcome      C2 ◄── Driver.read ◄────────────────    gauge, encoder

`read_config` reads a rig's file, `HardwareRig` runs it.
"""

from typing import TYPE_CHECKING

from estune.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from estune.hardware.config import RigConfig, read_config
    from estune.hardware.driver import Drive, Driver, Gauge, GaugeReading, Reading
    from estune.hardware.firmware import controller_source
    from estune.hardware.rig import HardwareRig

__all__ = [
    "Drive",
    "Driver",
    "Gauge",
    "GaugeReading",
    "HardwareRig",
    "Reading",
    "RigConfig",
    "controller_source",
    "read_config",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Drive": "estune.hardware.driver",
        "Driver": "estune.hardware.driver",
        "Gauge": "estune.hardware.driver",
        "GaugeReading": "estune.hardware.driver",
        "HardwareRig": "estune.hardware.rig",
        "Reading": "estune.hardware.driver",
        "RigConfig": "estune.hardware.config",
        "controller_source": "estune.hardware.firmware",
        "read_config": "estune.hardware.config",
    },
)
