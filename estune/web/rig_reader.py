"""Status, live samples and emergency stop of a rig for the page; never its lease."""

import dataclasses
import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from estune.errors import EstuneError, RigError
from estune.remote.zenoh import RemoteRig
from estune.trial import Telemetry
from estune.web.board import Board
from estune.web.reader import Reader

SAMPLES_PER_S = 200.0
"""Samples that a page is sent of a running trial; a screen shows no more."""
SAMPLES_MAX = 20_000
"""Samples of one trial that are kept."""
SHOWN_EVERY_S = 1.0
"""Least time between the beginnings of two trials whose samples are shown; no eye sees more."""
_DESCRIBED_EVERY = 8
"""Readings of the status between two of the description."""


class RigReader(Reader):
    """Reads a rig's status four times a second, and its samples as they come.

    Args:
        board: The board.
        connect: Opens the rig.
    """

    source = "rig"
    every_s = 0.25

    def __init__(self, board: Board, connect: Callable[[], RemoteRig]) -> None:
        super().__init__(board)
        self._connect = connect
        self._rig: RemoteRig | None = None
        self._readings = 0

    def read(self) -> None:
        """Reads the status; and now and then the description."""
        if self._rig is None:
            self._rig = self._connect()
            self._readings = 0
            threading.Thread(
                target=_follow, args=(self._rig, self.board), name="samples", daemon=True
            ).start()
        status = self._rig.status()
        shown = dataclasses.asdict(status) | {"sentence": status.mode.sentence}
        self.board.put("rig", shown)
        if self._readings % _DESCRIBED_EVERY == 0:
            rig = self._rig.describe()
            limits, settings = rig.limits, rig.controller
            self.board.put(
                "description",
                {
                    "name": rig.name,
                    "gains": list(rig.gains.as_tuple()),
                    "measurement": rig.measurement,
                    "command": rig.command,
                    "measurement_limits": [limits.tension_min_N, limits.tension_max_N],
                    "command_limits": [settings.output_min_N, settings.output_max_N],
                    "per_ampere": rig.newtons_per_ampere,
                    "step_at_s": rig.step.step_at_s,
                    "simulated": rig.simulated,
                },
            )
        self._readings += 1

    def estop(self, reason: str) -> str:
        """Brings the rig to its safe state; returns once the rig has answered.

        Raises:
            RigError: there is no link to the rig, or it has not answered.
        """
        rig = self._rig
        if rig is None:
            raise RigError("there is no link to the rig: cut its power")
        rig.estop(reason)
        return "the rig is on its way to its safe state"

    def release(self) -> None:
        """Disconnects."""
        rig, self._rig = self._rig, None
        if rig is not None:
            with suppress(EstuneError):
                rig.close()


def _follow(rig: RemoteRig, board: Board) -> None:
    """Puts the samples of each trial on the board, thinned, until the rig is closed."""
    trial_id, passed_over, kept, begun_s = "", "", 0, -math.inf
    with suppress(Exception), rig.watch() as batches:  # the link has ended: the status says so
        for batch in batches:
            restart = batch.trial_id != trial_id
            if restart:
                is_soon = time.monotonic() - begun_s < SHOWN_EVERY_S
                if is_soon or batch.trial_id == passed_over:
                    passed_over = batch.trial_id
                    continue
                trial_id, kept, begun_s = batch.trial_id, 0, time.monotonic()
                board.put("live", {"trial_id": trial_id})
            rows = _rows(batch)[: max(SAMPLES_MAX - kept, 0)]
            kept += len(rows)
            if rows or restart:
                board.extend("samples", rows, restart=restart)


def _rows(batch: Telemetry) -> list[tuple[float, float, float, float]]:
    """Time, setpoint, measurement and current of every k-th sample of the trial."""
    every = max(1, round(batch.sampling_Hz / SAMPLES_PER_S))
    first = -batch.first_sample % every
    places = range(first, batch.tension_N.size, every)
    return [
        (
            round((batch.first_sample + n) / batch.sampling_Hz, 6),
            float(batch.setpoint_N[n]),
            float(batch.tension_N[n]),
            float(batch.current_A[n]),
        )
        for n in places
    ]
