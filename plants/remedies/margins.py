"""Sensitivity peak of a simulated loop, with the compensations of a remedy or without."""

import json
import math
from collections.abc import Mapping
from typing import Any

from estune.core.gains import Gains
from estune.loop_model.fitting import fit_loop
from estune.loop_model.margins import robustness
from estune.trial import TrialRequest
from estune.trial.loop_records import loop_signals

RECORDS = 3
"""Steps that are identified together, as of a short run."""


def sensitivity(plant: Any, gains: Gains, tables: Mapping[str, Mapping[str, Any]]) -> float:
    """Ms of the loop identified from simulated steps; infinite where they do not identify it.

    A notch is part of the loop that the gains see, as it is in the records of a rig.
    """
    rig = plant.rig(gains=gains)
    about = rig.describe()
    text = json.dumps({name: dict(one) for name, one in tables.items()}) if tables else ""
    records = []
    for number in range(RECORDS):
        request = TrialRequest("margins", number, gains, about.step, compensation=text)
        signals = loop_signals(rig.run(request), about.step, about)
        if signals.record is None:
            return math.inf
        records.append(signals.record)
    fit = fit_loop(records, about.controller.sampling_Hz, about.settling_time_s)
    return robustness(fit.model, gains, about.controller).sensitivity
