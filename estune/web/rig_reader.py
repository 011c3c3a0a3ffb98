"""Status, live samples and emergency stop of a rig for the page; never its lease."""

import dataclasses
import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from estune.errors import EstuneError, RigError
from estune.remote.zenoh import RemoteRig
from estune.support.quantity_text import time_text
from estune.trial import RigDescription, Telemetry
from estune.web.board import Board
from estune.web.history import gain_labels
from estune.web.predicted import by_linear_model
from estune.web.reader import Reader

SAMPLES_PER_S = 200.0
"""Samples that a page is sent of a running trial; a screen shows no more."""
SAMPLES_MAX = 20_000
"""Samples of one trial that are kept."""
SHOWN_EVERY_S = 1.0
"""Least time between the beginnings of two trials whose samples are shown; no eye sees more."""
_DESCRIBED_EVERY = 8
"""Readings of the status between two of the description."""


def in_words(rig: RigDescription) -> str:
    """A rig in two sentences: what it controls, and its suggested trial."""
    kind = "A simulated rig" if rig.simulated else "A rig"
    rate, step, limits = rig.controller.sampling_Hz, rig.step, rig.limits
    what = f"controls {rig.measurement_name} by {rig.command_name}, {rate:g} times a second"
    final = rig.measured(step.preload_N + step.step_N)
    time = time_text(step.duration_s)
    trial = f"A trial steps from {step.preload_N:g} to {final} and takes {time}"
    ends = limits.tension_min_N, limits.tension_max_N
    if math.isfinite(ends[0]) and math.isfinite(ends[1]):
        trial += f"; setpoints from {ends[0]:g} to {rig.measured(ends[1])} are allowed"
    more = f" Software: {rig.software}." if rig.software else ""
    return f"{kind} that {what}. {trial}.{more}"


def run_of(trial_id: str) -> str:
    """The run that a trial belongs to."""
    return trial_id.rpartition("-")[0]


class RigReader(Reader):
    """Reads a rig's status four times a second, and its samples as they come.

    Args:
        run: The run whose trials alone are shown; empty for all trials.
        is_wanted: Whether the rig is to be read now. A finished run has no rig: what moves there
            belongs to another run.
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
    ) -> None:
        super().__init__(board)
        self._connect = connect
        self._run = run
        self._is_wanted = is_wanted
        self._described: RigDescription | None = None
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
            arguments = self._rig, self.board, self._run
            threading.Thread(target=_follow, args=arguments, name="samples", daemon=True).start()
        status = self._rig.status(with_last=True)
        if not is_wanted and not status.latched:  # an emergency stop that ended a run is shown
            self.release()
            self.board.put("rig", None)
            return
        if not status.holder:
            self.board.put("live", None)  # the record of the trial is shown then
        shown = dataclasses.asdict(status) | {"sentence": status.mode.sentence}
        self.board.put("rig", shown)
        if self._readings % _DESCRIBED_EVERY == 0:
            self._show_description(self._rig.describe())
            self.board.put("right", self._rig.right)
        self._readings += 1

    def _show_description(self, rig: RigDescription) -> None:
        """Shows the rig, and what its own model predicts of its live gains."""
        if rig == self._described:
            return
        self._described = rig
        limits, settings = rig.limits, rig.controller
        self.board.put(
            "description",
            {
                "name": rig.name,
                "text": in_words(rig),
                "gains": list(rig.gains.as_tuple()),
                "gain_labels": gain_labels(rig),
                "gain_bounds": [
                    f"{low:.4g} to {high:.4g}"
                    for _, (low, high) in rig.bounds_of(trial=False).items()
                ],
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
        predicted = by_linear_model(rig)
        self.board.put("predicted.rig", predicted and predicted.to_json())

    def estop(self, reason: str) -> str:
        """Brings the rig to its safe state; returns once the rig has answered.

        Where no reading has a link, it makes its own: a page that has just been opened, or whose
        rig was late once, would else refuse to stop a rig that answers.

        Raises:
            RigError: no link to the rig can be made, or it has not answered.
        """
        rig = self._rig
        if rig is None and not self._is_wanted():
            raise RigError("this run is not running; open the page of the rig to stop the rig")
        if rig is None or not self._has_stopped(rig, reason):
            self._estop_by_new_link(reason)
        return "the rig is on its way to its safe state"

    def _has_stopped(self, rig: RemoteRig, reason: str) -> bool:
        try:
            rig.estop(reason)
        except RigError:
            if rig is self._rig:
                raise
            return False  # a reading was late and closed the link: that says nothing of the rig
        return True

    def _estop_by_new_link(self, reason: str) -> None:
        try:
            rig = self._connect()
        except EstuneError as error:
            raise RigError(f"there is no link to the rig: cut its power ({error})") from error
        with rig:
            rig.estop(reason)

    def release(self) -> None:
        """Disconnects."""
        rig, self._rig = self._rig, None
        if rig is not None:
            with suppress(EstuneError):
                rig.close()


def number_of(trial_id: str) -> int | None:
    """The number of a trial in its run; None of an id that is not of this program."""
    digits = trial_id.rpartition("-")[2].partition(".")[0]
    return int(digits) if digits.isdecimal() else None


def _follow(rig: RemoteRig, board: Board, run: str) -> None:
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
                is_soon = time.monotonic() - begun_s < SHOWN_EVERY_S
                if is_soon or batch.trial_id == passed_over:
                    passed_over = batch.trial_id
                    continue
                trial_id, kept, begun_s = batch.trial_id, 0, time.monotonic()
                about = {"run": run_of(trial_id), "number": number_of(trial_id)}
                board.put("live", {"trial_id": trial_id} | about)
            rows = _rows(batch)[: max(SAMPLES_MAX - kept, 0)]
            kept += len(rows)
            if rows or restart:
                board.extend("samples", rows, restart=restart)
    board.put("live", None)


def _rows(batch: Telemetry) -> list[tuple[float, float, float, float]]:
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
