"""The experiment that shows what records of ordinary service do not."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.loop_model.intervals import setpoint_deviation
from estune.loop_model.loop_fit import NORMAL_QUANTILE
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.run.trial_file import TrialFile
from estune.service_records.identification import ServiceLoop
from estune.service_records.judgement import HALF_WIDTH_MAX
from estune.support.quantity_text import time_text
from estune.trial.profiles import MultisineProfile

SHARES = (0.01, 0.02, 0.05)
"""Multisines that are considered, rms as a share of the step: the least that is enough."""

BAND = (0.2, 6.0)
"""Their band, in periods per settling time: it holds the crossover of any loop that settles so."""

SLOPE = -0.5
"""Exponent of their amplitudes over frequency: as much power in each octave. Of the crossover only
the band is known that holds it; this alone shows as much wherever in the band it is."""

PERIOD = 20.0
"""Their period, settling times."""

LONGEST = 400.0
"""Duration that is asked for at most, settling times."""

AIM = 0.5 * HALF_WIDTH_MAX
"""Half width of ln Ms that the experiment is to reach."""

NYQUIST_SHARE = 0.8
"""Highest frequency, over half the sampling rate."""


class AdvisedExperiment(NamedTuple):
    """A hold of the setpoint with a multisine on it.

    Attributes:
        share: Its rms over the step.
        aim: Half width of ln Ms that it reaches by the identified loop.
    """

    share: float
    duration_s: float
    aim: float
    trial: TrialFile


def advice(found: AdvisedExperiment | None) -> str:
    """What to record to know more, in a sentence."""
    if found is None:
        return (
            "Run step trials instead: `estune tune` on a rig, or log a few steps of the setpoint "
            "that move the measurement well beyond its noise."
        )
    return (
        f"To know Ms to {math.expm1(found.aim):.0%}, hold the setpoint with a multisine of "
        f"{found.share:.0%} of the step (rms) from {_Hz(found.trial, first=True):.3g} to "
        f"{_Hz(found.trial, first=False):.3g} Hz for {time_text(found.duration_s)}."
    )


def advise(
    loop: ServiceLoop, trial: StepTrial, gains: Gains, aim: float = AIM
) -> AdvisedExperiment | None:
    """The gentlest multisine that would show ln Ms to a half width; None where none would."""
    fit, settling_s, rate = loop.fit, trial.cost.settling_time_s, trial.controller.sampling_Hz
    middle = float(np.mean(np.concatenate([record.setpoint for record in loop.records])))
    for share in SHARES:
        profile = multisine(middle, share * abs(trial.step.size), settling_s, rate)
        setpoint = profile.setpoint(rate)
        still = np.zeros(setpoint.size)
        record = LoopRecord(still, still, setpoint, gains)
        half = NORMAL_QUANTILE * setpoint_deviation(fit, [record], gains, trial.controller)
        if half <= aim * math.sqrt(LONGEST / PERIOD):
            periods = max(math.ceil((half / aim) ** 2), 1)
            length_s = periods * profile.period_s
            whole = replace(profile, duration_s=length_s)
            file = TrialFile("multisine", whole, gains, "to know the margins of the gains in use")
            return AdvisedExperiment(share, length_s, aim, file)
    return None


def multisine(
    middle: float, rms: float, settling_time_s: float, sampling_Hz: float
) -> MultisineProfile:
    """A period of a multisine about a setpoint, in the band of a loop that settles so."""
    length_s = PERIOD * settling_time_s
    highest = min(BAND[1] * PERIOD, NYQUIST_SHARE * 0.5 * sampling_Hz * length_s)
    return MultisineProfile(
        preload_N=middle,
        rms_N=rms,
        period_s=length_s,
        first_line=max(round(BAND[0] * PERIOD), 1),
        last_line=max(math.floor(highest), 2),
        duration_s=length_s,
        slope=SLOPE,
        corner_Hz=BAND[0] / settling_time_s,
    )


def _Hz(trial: TrialFile, *, first: bool) -> float:
    profile = trial.profile
    assert isinstance(profile, MultisineProfile)  # noqa: S101  made above
    return (profile.first_line if first else profile.last_line) / profile.period_s
