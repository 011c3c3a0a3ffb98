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


def run_of(trial_id: str) -> str:
    """The run that a trial belongs to."""
    return trial_id.rpartition("-")[0]


class RigReader(Reader):
    """Reads a rig's status four times a second, and its samples as they come.

    Args:
        board: The board.
        connect: Opens the rig.
        run: The run whose trials alone are shown; empty for all trials.
        is_wanted: Whether the rig is to be read now. A finished run has no rig: what moves there
            belongs to another run.
        on_run: Called with the run of each trial that is seen.
    """

    source = "rig"
    every_s = 0.25

    def __init__(
        self,
        board: Board,
        connect: Callable[[], RemoteRig],
        *,
        run: str = "",
        is_wanted: Callable[[], bool] = lambda: True,
        on_run: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(board)
        self._connect = connect
        self._run = run
        self._is_wanted = is_wanted
        self._on_run = on_run
        self._rig: RemoteRig | None = None
        self._readings = 0

    def read(self) -> None:
        """Reads the status; and now and then the description."""
        is_wanted = self._is_wanted()
        if self._rig is None and not is_wanted:
            return
        if self._rig is None:
            self._rig = self._connect()
            self._readings = 0
            arguments = self._rig, self.board, self._run, self._on_run
            threading.Thread(target=_follow, args=arguments, name="samples", daemon=True).start()
        status = self._rig.status()
        if not is_wanted and not status.latched:  # an emergency stop that ended a run is shown
            self.release()
            self.board.put("rig", None)
            return
        if status.trial_id:
            self._on_run(run_of(status.trial_id))
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
                    "duration_s": rig.step.duration_s,
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
            if not self._is_wanted():
                raise RigError("this run is not running; open the page of the rig to stop the rig")
            raise RigError("there is no link to the rig: cut its power")
        rig.estop(reason)
        return "the rig is on its way to its safe state"

    def release(self) -> None:
        """Disconnects."""
        rig, self._rig = self._rig, None
        if rig is not None:
            with suppress(EstuneError):
                rig.close()


def _follow(rig: RemoteRig, board: Board, run: str, on_run: Callable[[str], None]) -> None:
    """Puts the samples of each trial on the board, thinned, until the rig is closed.

    Of a run, if one is given, the trials of others are passed over.
    """
    trial_id, passed_over, kept, begun_s = "", "", 0, -math.inf
    with suppress(Exception), rig.watch() as batches:  # the link has ended: the status says so
        for batch in batches:
            restart = batch.trial_id != trial_id
            if run and run_of(batch.trial_id) != run:
                continue
            if restart:
                on_run(run_of(batch.trial_id))
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
    board.put("live", None)


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
