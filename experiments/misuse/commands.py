"""Commands at random against a live rig, on the command line and on the wire."""

import contextlib
import io
import math
import os
import signal
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random

from estune.cli import app, run
from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.remote import zenoh
from estune.remote.zenoh import RemoteRig
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile

INTERRUPT_S = 5.0
"""Time after which a command is interrupted as by Ctrl-C, and again for each more."""

ON_RIG = ("tune", "discover", "doctor", "apply", "estop", "clear", "run-experiment", "prove")
OTHERS = (
    *("resume", "sweep", "match", "compare", "list", "show", "report", "export", "suggest"),
    *("export-controller", "records", "explain", "remedy", "daemon-control", "faults"),
)
"""Commands that end by themselves, and leave files in the working directory alone."""

NUMBERS = (0.0, -0.0, 1e-300, 0.4, 12.0, 1e3, 1e19, 1e308, -1.0, math.inf, -math.inf, math.nan)
WORDS = (
    *(
        "",
        " ",
        "-",
        "--",
        "nan",
        "inf",
        "-1",
        "0",
        "1",
        "1e19",
        "1e999",
        "9" * 400,
        "x",
        "µ",
        "\x01a",
    ),
    *("P=1", "P=1e19,I=1", "P=,I=2", "P=nan", "a=b=c", "time=t[ms]", "[1]", "[[", "{}", "none"),
    *(
        "..",
        "/",
        "/dev/null",
        "runs",
        "one",
        "rig.toml",
        "model.toml",
        "record.csv",
        "plants:nothing",
    ),
    *(
        "plants:reference_reel",
        "tcp/127.0.0.1:9",
        "tcp/127.0.0.1:x",
        "tls/127.0.0.1:1",
        "25%",
        "400%",
    ),
)


class Commands:
    """Commands, and what came of them.

    Attributes:
        counts: Number of commands by name and exit code, or answer.
        faults: Tracebacks, and gains beyond the rig's bounds.
    """

    def __init__(self, endpoint: str, folder: Path, seed: int) -> None:
        self._endpoint, self._folder = endpoint, folder
        self._random = Random(seed)  # noqa: S311  nothing here is secret
        self.counts: Counter[str] = Counter()
        self.faults: list[str] = []

    def run(self, number: int) -> None:
        """Runs a number of them, a third on the wire."""
        with zenoh.connect(self._endpoint, timeout_s=30.0) as rig:
            for k in range(number):
                if k % 3 == 0:
                    self._on_the_wire(rig)
                else:
                    self._on_the_line()
                if k % 50 == 0:
                    self._check_gains(rig)
            rig.clear()
            self._check_gains(rig)

    def _check_gains(self, rig: RemoteRig) -> None:
        about = rig.describe()
        try:
            about.check_gains(about.gains)
        except EstuneError as error:
            self.faults.append(f"live gains are beyond the rig's bounds: {error}")

    def _on_the_wire(self, rig: RemoteRig) -> None:
        pick = self._random.choice
        verb = pick(("apply", "run", "run", "estop", "clear", "clear", "abort", "switch_off"))
        a, b, c, d = (pick(NUMBERS) for _ in range(4))
        try:
            match verb:
                case "apply":
                    rig.apply(Gains(a, b, c, d))
                case "run":
                    profile = StepProfile(15.0, pick((5.0, a)), 0.1, pick((0.5, b)))
                    gains = Gains(pick((0.4, c)), pick((12.0, d)), 0.01, 0.03)
                    rig.run(TrialRequest("misuse", self._random.randrange(10**6), gains, profile))
                case "estop":
                    rig.estop(pick(WORDS))
                case "clear":
                    rig.clear()
                case "abort":
                    rig.abort()
                case _:
                    rig.switch_off([pick(WORDS)])
        except EstuneError as error:
            self.counts[f"wire {verb}, {type(error).__name__}"] += 1
        except Exception:  # noqa: BLE001  this experiment looks for them
            self.faults.append(f"wire {verb}: {traceback.format_exc()}")
        else:
            self.counts[f"wire {verb}, done"] += 1

    def _on_the_line(self) -> None:
        name = self._random.choice(ON_RIG if self._random.random() < 0.5 else OTHERS)
        words = [name, *self._arguments(name)]
        said = io.StringIO()
        try:
            with (
                _interrupted(),
                contextlib.redirect_stdout(said),
                contextlib.redirect_stderr(said),
            ):
                code = run(words)
        except Exception:  # noqa: BLE001  as above
            self.faults.append(f"{words}: {traceback.format_exc()}")
            return
        except SystemExit as end:
            code = -1 if end.code is None else int(end.code)
        if "Traceback" in said.getvalue():
            self.faults.append(f"{words}: {said.getvalue()[-2000:]}")
        self.counts[f"{name}, code {code}"] += 1

    def _arguments(self, name: str) -> Iterator[str]:
        """Right and wrong words: the rig's endpoint, options of the command with any value."""
        random = self._random
        options = [
            argument.name
            for argument in app[name].assemble_argument_collection()
            if argument.name.startswith("--")
        ]
        if random.random() < 0.7:
            yield (
                "one"
                if name in ("apply", "show", "report", "export", "resume")
                else (self._endpoint if name in ON_RIG else random.choice(WORDS))
            )
        if name in ON_RIG and random.random() < 0.8:
            yield self._endpoint
        for _ in range(random.randint(0, 3)):
            yield random.choice(options)
            if random.random() < 0.8:
                yield random.choice(WORDS)
        if name == "tune":
            yield from ("--trials", "1", "--repeats", "1", "--folder", str(self._folder / "runs"))


@contextlib.contextmanager
def _interrupted() -> Iterator[None]:
    """Ctrl-C for a command that takes long."""

    def stop(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, INTERRUPT_S, INTERRUPT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
