"""A client process: one tuning, started or resumed, over a disturbed link.

    python -m experiments.chaos.client JSON

Its exit code is that of `estune tune` or `estune resume`; it prints errors on standard error.
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
from estune.run.plan import Plan
from estune.run.planning import make_plan
from estune.trial import RigDescription
from experiments.chaos.mischief import Mischief, disturbed
from experiments.chaos.motions import LoggedRig
from experiments.chaos.rig import reference_rig

INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Errand:
    """Task of a client.

    Attributes:
        endpoint: Endpoint of its rig.
        rig: Name of the rig.
        folder: Folder of the runs.
        run: Name of the run.
        tuner: Name of the tuner.
        start: Initial gains.
        trials: Search trials.
        seed: Seed of the mischief.
    """

    endpoint: str
    rig: str
    folder: str
    run: str
    tuner: str
    start: tuple[float, float, float, float]
    trials: int
    seed: int

    def dump(self) -> str:
        """The errand as one argument of a command."""
        return json.dumps(asdict(self))

    @property
    def journal(self) -> Path:
        """Folder of the run."""
        return Path(self.folder) / self.run

    def plan(self) -> tuple[RigDescription, Plan]:
        """The rig, and the plan that the client follows."""
        description = LoggedRig(reference_rig(self.rig)).describe()
        plan = make_plan(
            *(description, self.run),
            tuner=self.tuner,
            start=Gains(*self.start),
            bounds=None,
            step=None,
            cost=None,
            trials=self.trials,
        )
        return description, plan


def tune(errand: Errand) -> None:
    """Tunes, or resumes the run of an earlier client."""
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
    """Executes the errand; returns the exit code."""
    # Shells let what they start in the background ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    errand = Errand(**json.loads(text))
    mischief = Mischief(errand.endpoint, errand.seed)
    try:
        # All commands pass through this method.
        RigConnection.ask = disturbed(RigConnection.ask, mischief)  # type: ignore[method-assign]
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
