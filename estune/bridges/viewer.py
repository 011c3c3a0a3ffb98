"""A rig's samples and status for a program that shows them; never its lease."""

import math
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from estune.core.gains import GAIN_NAMES
from estune.errors import RigError
from estune.remote.messages import Status
from estune.remote.zenoh import RemoteRig
from estune.trial import RigDescription, Telemetry

STATUS_EVERY_s = 1.0


class ViewedSample(NamedTuple):
    """One sample of a running trial.

    Attributes:
        time_ns: Time of day of the sample, ns since 1970.
        setpoint_N: Setpoint, in the unit of what the rig measures; so is the tension.
    """

    time_ns: int
    setpoint_N: float
    tension_N: float
    current_A: float
    angle_rad: float

    def values(self) -> dict[str, float]:
        """What was measured, by name; JSON has no word for a value outside the calibration."""
        named = self._asdict()
        del named["time_ns"]
        return {name: value for name, value in named.items() if math.isfinite(value)}


@dataclass(frozen=True, slots=True)
class ViewedRig:
    """A rig between two readings of its status; None for what it has not answered."""

    time_ns: int
    status: Status | None
    about: RigDescription | None

    def values(self) -> dict[str, Any]:
        """The status and the live gains as values of JSON."""
        values: dict[str, Any] = {"answers": int(self.status is not None)}
        if self.status is not None:
            values |= {"mode": self.status.mode.value, "latched": int(bool(self.status.latched))}
        if self.about is not None:
            values["gains"] = {name: getattr(self.about.gains, name) for name in GAIN_NAMES}
        return values


class Viewer(Protocol):
    """A program that shows rigs."""

    def show_samples(self, samples: list[ViewedSample]) -> None:
        """Shows samples of a running trial."""
        ...

    def show_state(self, state: ViewedRig) -> None:
        """Shows the rig's status."""
        ...


class TrialClock(NamedTuple):
    """Time of day of a trial's first sample, from the arrival of its first telemetry."""

    trial_id: str = ""
    start_ns: int = 0

    def after(self, batch: Telemetry, arrival_ns: int) -> "TrialClock":
        """The clock after a batch of telemetry: of its trial."""
        if batch.trial_id == self.trial_id:
            return self
        last = batch.first_sample + batch.tension_N.size - 1
        return TrialClock(batch.trial_id, arrival_ns - round(1e9 * last / batch.sampling_Hz))

    def samples(self, batch: Telemetry) -> Iterator[ViewedSample]:
        """The samples of a batch with their times."""
        columns = (batch.setpoint_N, batch.tension_N, batch.current_A, batch.angle_rad)
        for n, row in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            passed_ns = round(1e9 * (batch.first_sample + n) / batch.sampling_Hz)
            yield ViewedSample(self.start_ns + passed_ns, *row)


def follow(
    rig: RemoteRig, batches: Iterator[Telemetry], viewer: Viewer, ended: threading.Event
) -> None:
    """Shows a rig until `ended` is set.

    Raises:
        Exception: whatever the viewer raises when it is shown samples.
    """
    faults: list[Exception] = []

    def show_samples() -> None:
        try:
            clock = TrialClock()
            for batch in batches:
                clock = clock.after(batch, time.time_ns())
                viewer.show_samples(list(clock.samples(batch)))
        except Exception as error:  # noqa: BLE001  raised by the thread that waits
            faults.append(error)
            ended.set()

    threading.Thread(target=show_samples, name="samples", daemon=True).start()
    while not ended.is_set():
        viewer.show_state(_state(rig))
        ended.wait(STATUS_EVERY_s)
    if faults:
        raise faults[0]


def _state(rig: RemoteRig) -> ViewedRig:
    status = about = None
    with suppress(RigError):  # silent for now
        status, about = rig.status(), rig.describe()
    return ViewedRig(time.time_ns(), status, about)
