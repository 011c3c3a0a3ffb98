"""A reel on real hardware: driver, real-time loop in a process of its own, and the rig around it.

::

    HardwareRig  (this process)          loop process                          hardware
      requests, records, heartbeat  ──►  guard ─► PIDF ─► C1 ─► Driver.write ─►  amplifier
               ◄── columns, outcome      C2 ◄── Driver.read ◄────────────────    gauge, encoder

`read_config` reads a rig's file, `HardwareRig` runs it. A board that closes the loop itself is a
`trial_board.rig.BoardRig`.

**Guarantees.** What the guard finds at a sample decides the current of that same sample. The loop
waits for nobody: it brings the reel to rest when its rig is gone, when it is told to, or when
readings stay bad, and the driver's own watchdog ends the current when the loop is gone. A device
that misbehaves or is unplugged ends no process (`driver_link`, `reel_machine.bridge`). Live
gains are back at the end of every trial. After a stop the rig takes no trial until it is cleared.
None of this is an emergency stop: a machine that can hurt people needs a switch in its power.

**Theory of operation.** The rig writes setpoint and weights of the cost into memory shared with
the loop (`shared_memory`; each number has one writer) and sends `Begin` through a pipe; the loop
takes up the slack, settles at the preload, runs the trial and answers `Ended`.
`reel_state_machine` is all of its logic, without clock or hardware, so that tests run it in
virtual time. The controller is C generated from `estune.core.pidf`, compiled once, and the same
text is exported for firmware.

**Choices that are not obvious.** The loop is a process and not a thread: the interpreter lock of a
rig that decodes a record is held longer than a sample lasts. It sleeps to an absolute time and
watches the clock for the last 100 us (`loop` has the measured lateness: 38 us at worst of 2000
samples instead of 1160). Calibrations are evaluated in single floats (`scales`), as the arrays of
`estune.reel.calibration` take 25 to 110 us of the 1580 us of a sample. Flags are polled in shared
memory at every sample, so that a stop waits for no message.

**Tried and lost.** python-can and pyserial in place of `drivers.can_bus` and
`drivers.serial_port`: 20 000 round trips of each, in turn, to an echo in another process took 22 %
longer at the median with python-can (on a socket pair) and 30 % with pyserial (on a
pseudo-terminal), and as long at the 99.9th centile, which was the machine's. Both are read and
written once a sample, so that this is the loop's own time. A loop on the host behind an adapter
that answers late (an FTDI chip with its latency timer of 16 ms, a gauge slower than the loop) is
refused or named by `doctor`, and belongs on the board (`trial_board`).
"""

from typing import TYPE_CHECKING

from estune.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from estune.hardware.config import RigConfig, read_config
    from estune.hardware.driver import (
        Drive,
        Driver,
        Gauge,
        GaugeReading,
        Position,
        Reading,
        bad_reading,
    )
    from estune.hardware.firmware import controller_source
    from estune.hardware.rig import HardwareRig

__all__ = [
    "Drive",
    "Driver",
    "Gauge",
    "GaugeReading",
    "HardwareRig",
    "Position",
    "Reading",
    "RigConfig",
    "bad_reading",
    "controller_source",
    "read_config",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "estune.hardware.config": ("RigConfig", "read_config"),
        "estune.hardware.driver": (
            "Drive",
            "Driver",
            "Gauge",
            "GaugeReading",
            "Position",
            "Reading",
            "bad_reading",
        ),
        "estune.hardware.firmware": ("controller_source",),
        "estune.hardware.rig": ("HardwareRig",),
    },
)
