"""What a page may do with a rig: try gains, apply them, reset a stop, tune. Each action is noted.

An action is that of any client: it asks the rig for its lease, and is refused where another has
it. A tuning is the command `estune tune` in a process of its own.
"""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from estune.core.cost import cost_from
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import EstuneError, InvalidInput, RigError
from estune.remote.zenoh import RemoteRig
from estune.run.journal import FILE_NAME, being_written
from estune.support.quantity_text import time_text
from estune.trial import Outcome, RigDescription, TrialRecord, TrialRequest
from estune.trial.scoring import cost_of, metrics_of
from estune.web.board import Board
from estune.web.history import curve
from estune.web.run_actions import note_action
from estune.web.tuning_form import read_settings

Arguments = Mapping[str, Any]
TRIED = "try-"
"""Begin of the trial id of gains that are tried once; no run is made of it."""
_END_WITHIN_S = 10.0


@dataclass(eq=False)
class RigActions:
    """Actions on one rig, one at a time.

    Attributes:
        may_tune: Whether a process of its own could connect: credentials are not handed on.
    """

    connect: Callable[[str], RemoteRig]
    board: Board
    endpoint: str
    rig: str
    folder: Path
    may_tune: bool = True
    _busy: threading.Lock = field(default_factory=threading.Lock)
    _tuning: "subprocess.Popen[str] | None" = None
    _run: str = ""
    _noted: int = 0

    def commands(self) -> dict[str, Callable[[str, Arguments], str]]:
        """The actions by name."""
        return {
            "try": self.try_gains,
            "apply": self.apply,
            "reset": self.clear,
            "tune": self.tune,
            "stop": self.stop,
            "resume": self.resume,
        }

    def try_gains(self, who: str, given: Arguments) -> str:
        """Runs one trial with some gains; the rig then restores its live ones."""
        gains = _gains(given.get("gains"))

        def act(rig: RemoteRig) -> str:
            before = rig.describe()
            run = f"{TRIED}{datetime.now().astimezone():%Y%m%d-%H%M%S}"
            record = rig.run(TrialRequest(run, 0, gains, before.step))
            after = rig.describe().gains
            measured = _measured(record, before)
            tried = {"gains": list(gains.as_tuple()), "measured": measured}
            self.board.put("curve.tried", curve(record, before) | tried)
            if after != before.gains:
                raise RigError(f"the rig runs {after}, not its gains from before: {before.gains}")
            return f"{measured}; the rig has its live gains again"

        return self._noted_action("try", who, gains, act)

    def apply(self, who: str, given: Arguments) -> str:
        """Makes gains live that somebody has confirmed, seeing those that they replace."""
        gains, seen = _gains(given.get("gains")), _gains(given.get("instead_of"))

        def act(rig: RemoteRig) -> str:
            before = rig.describe().gains
            if before != seen:
                raise RigError(f"the live gains have changed meanwhile, to {before}; look again")
            rig.apply(gains)
            after = rig.describe().gains
            if after != gains:
                raise RigError(f"the rig runs {after}, not the requested gains; check the rig")
            return f"the rig confirms: these gains are live, instead of {before}"

        return self._noted_action("apply", who, gains, act)

    def clear(self, who: str, _given: Arguments) -> str:
        """Resets the emergency stop."""

        def act(rig: RemoteRig) -> str:
            rig.clear()
            return "the emergency stop is reset"

        return self._noted_action("reset", who, None, act)

    def tune(self, who: str, given: Arguments) -> str:
        """Starts a tuning with the settings of a form; empty ones are the rig's or the default."""
        settings = read_settings(given.get("settings") or {})
        if self.may_tune:
            with self.connect(who) as rig:
                settings.check(rig.describe())
        run = f"page-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
        named = ("--run", run, "--folder", str(self.folder), "--rig", self.rig)
        self._start(run, "tune", self.endpoint, *named, "--quiet", *settings.options)
        return self._note("tune", who, f"run {run} begins {' '.join(settings.options)}".strip())

    def resume(self, who: str, given: Arguments) -> str:
        """Continues a run that was stopped or interrupted."""
        folder = self.folder / str(given.get("run", ""))
        if folder.parent != self.folder or not (folder / FILE_NAME).is_file():
            raise InvalidInput(f"there is no run {given.get('run')!r} in {self.folder}")
        if being_written(folder):
            raise InvalidInput(f"run {folder.name} is running already")
        self._start(folder.name, "resume", str(folder), "--quiet")
        return self._note("resume", who, f"run {folder.name} continues")

    def stop(self, who: str, _given: Arguments) -> str:
        """Stops the tuning that was started here; it can be resumed."""
        process = self._tuning
        if process is None or process.poll() is not None:
            raise InvalidInput(
                "no tuning was started on this page; stop one in its own terminal with Ctrl-C, or "
                "the rig with the emergency stop"
            )
        process.send_signal(signal.SIGINT)
        return self._note("stop", who, "the tuning ends, and the rig restores its live gains")

    def close(self) -> None:
        """Stops the tuning that was started here, and waits until the rig is restored.

        Where the rig is lost nothing can be waited for: its lease ends by itself.
        """
        process = self._tuning
        if process is not None and process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_END_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _noted_action(
        self, name: str, who: str, gains: Gains | None, act: Callable[[RemoteRig], str]
    ) -> str:
        if not self._busy.acquire(blocking=False):
            raise RigError("another action of this page is under way at the rig; wait for it")
        try:
            self._note(name, who, f"asked{f' for {gains}' if gains else ''}")
            try:
                with self.connect(who) as rig:
                    sentence = act(rig)
            except EstuneError as error:
                self._note(name, who, f"not done: {error}")
                raise
            return self._note(name, who, sentence)
        finally:
            self._busy.release()

    def _start(self, run: str, *words: str) -> None:
        if not self.may_tune:
            raise InvalidInput(
                "this rig needs credentials; start the tuning in a terminal: estune tune "
                f"{self.endpoint} --security FILE"
            )
        if self._is_tuning():
            raise InvalidInput("a tuning that was started here is still running; stop it first")
        self.folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-P", "-m", "estune", *words]
        self._tuning = subprocess.Popen(  # noqa: S603  our own interpreter and module
            *(command,), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        self._run = run
        self.board.put("begun", {"run": run, "fault": ""})
        threading.Thread(target=self._follow, args=(run, self._tuning), daemon=True).start()

    def _is_tuning(self) -> bool:
        """Whether the tuning that was started here may still move the rig.

        Its process draws figures once the run has ended.
        """
        if self._tuning is None or self._tuning.poll() is not None:
            return False
        folder = self.folder / self._run
        return not (folder / FILE_NAME).is_file() or being_written(folder)

    def _follow(self, run: str, process: "subprocess.Popen[str]") -> None:
        """Notes how a tuning ended, with the last line that it printed if it failed."""
        _, text = process.communicate()
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        why = f": {lines[-1]}" if lines and process.returncode else ""
        if run == self._run:  # else the next one has begun while this one drew its figures
            self.board.put("begun", {"run": run, "fault": lines[-1]} if why else None)
        self._note("tune", "estune", f"the tuning has ended with code {process.returncode}{why}")

    def _note(self, name: str, who: str, sentence: str) -> str:
        at = note_action(self.folder, self.rig, name, who, sentence)
        self._noted += 1
        self.board.extend("events", [(self._noted, at, name, f"{who}: {sentence}")])
        return sentence


def _gains(given: Any) -> Gains:
    try:
        return Gains(*(float(given[name]) for name in GAIN_NAMES))
    except (TypeError, KeyError, ValueError) as error:
        raise InvalidInput(f"give a number for each of {', '.join(GAIN_NAMES)}") from error


def _measured(record: TrialRecord, rig: RigDescription) -> str:
    """How a trial went."""
    if record.outcome is not Outcome.DONE:
        return f"the trial ended early: {record.reason or record.outcome}"
    cost = cost_from("paper", rig.settling_time_s).scaled(rig.effort_scale)
    shown = cost_of(record, rig.step, cost, rig.newtons_per_ampere)
    response = metrics_of(record, rig.step)
    rise = time_text(response.rise_time_s) if response.rise_time_s > 0.0 else "not reached"
    return f"cost {shown:.3g}, rise {rise}, overshoot {response.overshoot:.1%}"
