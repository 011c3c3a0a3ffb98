"""A client process: one tuning, begun or gone on with, over a link that is meddled with.

    python -m experiments.chaos.client JSON

Ends with the exit code that `estune tune` or `estune resume` would have, and on standard error
the sentence.
"""

import json
import signal
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from estune import api
from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.remote.zenoh.rig_connection import RigConnection
from estune.run.journal import FILE_NAME
from experiments.chaos.mischief import Mischief, meddle
from experiments.chaos.plain import tune_plainly

INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Errand:
    """What a client is to do.

    Attributes:
        endpoint: Where its rig is.
        rig: Name of the rig.
        folder: Where runs are kept.
        run: Name of the run.
        tuner: Name of the tuner.
        start: The gains to begin from.
        trials: Search trials.
        plain: Whether to ask by plain gets.
        seed: Seed of the mischief.
    """

    endpoint: str
    rig: str
    folder: str
    run: str
    tuner: str
    start: tuple[float, float, float, float]
    trials: int
    plain: bool = False
    seed: int = 0

    def dump(self) -> str:
        """As one argument of a command."""
        return json.dumps(asdict(self))

    @property
    def journal(self) -> Path:
        """The folder of the run."""
        return Path(self.folder) / self.run


def tune(errand: Errand) -> None:
    """Tunes, or goes on where a client before this one was stopped."""
    if (errand.journal / FILE_NAME).exists():
        api.resume(errand.journal, watch=None)
        return
    api.tune(
        errand.endpoint,
        rig=errand.rig,
        run=errand.run,
        folder=errand.folder,
        tuner=errand.tuner,
        start=Gains(*errand.start),
        trials=errand.trials,
        watch=None,
    )


def main(text: str) -> int:
    """Does the errand; returns the exit code."""
    # Shells let what they start in the background ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    errand = Errand(**json.loads(text))
    mischief = Mischief(errand.endpoint, errand.seed)
    try:
        if errand.plain:
            tune_plainly(errand.endpoint, errand.journal, errand, mischief)
        else:
            # The one place that all commands pass.
            RigConnection.ask = meddle(RigConnection.ask, mischief)  # type: ignore[method-assign]
            tune(errand)
    except EstuneError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        mischief.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
