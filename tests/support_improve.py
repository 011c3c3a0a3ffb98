"""A reel to be improved, and what rigs of it say of themselves."""

from dataclasses import replace

import plants
from estune.trial import TrialRequest
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.experiments.designs import initial_experiments
from plants.improvement.experiment_runner import ExperimentRunner
from plants.improvement.tuning import ImprovementOptions

REEL = plants.reference_reel()
GAINS = REEL.describe("rig", None).gains
# A search that takes no time: the default one fits the friction of each rig for ten seconds.
SHORT = ImprovementOptions("least_squares_gradient", model_trials=10, rig_trials=2, watch=None)
FEW = ("coulomb_friction", "eyelet_friction", "dead_time")
RIGS = {
    "reel": REEL,
    "long, slack reel": plants.reference_reel(1.4, 8.0),
    "narrow limits": plants.reference_reel(tension_min_N=12.0, tension_max_N=18.0),
    "unloaded reel": plants.unloaded_reel(),
}


def about(name):
    return RIGS[name].describe("rig", None)


def records(reel, seed=0):
    rig = reel.rig(seed=seed)
    known = rig.describe()
    return [
        MeasuredRecord.of(rig.run(TrialRequest("battery", n, known.gains, one.profile)))
        for n, one in enumerate(initial_experiments(known))
    ]


def watched(rig, at, action):
    """The rig, whose trial of that number is replaced; and the ids of the trials it runs."""
    real, ids = rig.run, []

    def run(request):
        ids.append(request.trial_id)
        return action(request, real) if len(ids) == at else real(request)

    rig.run = run
    return ids


def runner(rig, folder):
    """Trials on a rig that says it moves."""
    about = replace(rig.describe(), simulated=False)
    return ExperimentRunner(rig, about, folder, "now", lambda _: None)
