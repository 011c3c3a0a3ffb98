"""Task of a client process: one tuning."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from estune.core.gains import Gains
from estune.run.plan import Plan
from estune.run.planning import make_plan
from estune.trial import RigDescription
from experiments.chaos.motions import LoggedRig
from experiments.chaos.rig import reference_rig


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
