"""Response to the suggested step with the live gains, where a model of the rig is known."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from estune.core.cost import cost_from
from estune.core.gains import Gains
from estune.core.margins import largest_sensitivity
from estune.core.metrics import step_metrics
from estune.core.quantities import FloatArray
from estune.interop import margins, sampled_model
from estune.loop_model.prediction import StepTrial, expected_response, predict
from estune.run.planning import step_trial
from estune.run.results.result import TuneResult
from estune.run.results.summary import rise_text, share_text
from estune.run.start import simulated_step
from estune.trial import RigDescription
from estune.web.history import points

SAMPLES_MAX = 20_000
"""Longest trial that is simulated on a rig's linear model: it takes 0.5 s, sample by sample."""


class PredictedResponse(NamedTuple):
    """A step response that a model predicts.

    Attributes:
        measurement: Likewise.
        cells: Rise time, overshoot, Ms and phase margin as text, by label.
    """

    source: str
    time_s: FloatArray
    setpoint: FloatArray
    measurement: FloatArray
    cells: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """The response as a page draws it."""
        curves = {"t": self.time_s, "r": self.setpoint, "y": self.measurement}
        shown = {name: points(values) for name, values in curves.items()}
        return {"source": self.source, "cells": list(self.cells.items()), **shown}


def by_identified_loop(result: TuneResult, gains: Gains, source: str) -> PredictedResponse | None:
    """The response by the loop identified from a run; None without one, or if it is unstable."""
    plan, rig, fit = result.plan, result.rig, result.identified.fit
    if fit is None:
        return None
    rest = float(np.mean([one.rest_effort for one in result.identified.signals]))
    trial = replace(step_trial(rig, plan.step, plan.cost), rest_effort=rest)
    found = predict(fit.model, trial, gains)
    if not math.isfinite(found.sensitivity):
        return None
    response = expected_response(fit.model, trial, gains)
    return _response(source, trial, response, found.sensitivity, found.phase_margin_deg)


def by_linear_model(rig: RigDescription) -> PredictedResponse | None:
    """The response by the rig's own linear model; None without one, or where it is unstable."""
    cost = cost_from("paper", rig.settling_time_s)
    if rig.linear_model is None or rig.step.samples(rig.controller.sampling_Hz) > SAMPLES_MAX:
        return None
    shown = margins(rig.linear_model, rig.gains, rig.controller)
    if not shown.stable:
        return None
    free = replace(rig.controller, output_min_N=-math.inf, output_max_N=math.inf)
    trial = replace(step_trial(rig, rig.step, cost), controller=free)
    plant = sampled_model(rig.linear_model, rig.controller)
    response = simulated_step(plant, trial, rig.gains).measurement
    sensitivity = largest_sensitivity(plant, rig.gains, rig.controller)
    source = "the rig's own linear model, whose accuracy is not known"
    return _response(source, trial, response, sensitivity, shown.phase_margin_deg)


def _response(
    source: str, trial: StepTrial, response: FloatArray, Ms: float, phase_margin_deg: float
) -> PredictedResponse:
    """A response as a deviation, with its numbers."""
    rate, at, size = trial.controller.sampling_Hz, trial.step.sample, trial.step.size
    time_s = (np.arange(trial.samples) - at) / rate
    tracked = time_s[: trial.end], response[: trial.end]
    known = step_metrics(*tracked, step_time_s=0.0, initial=0.0, final=size)
    return PredictedResponse(
        source,
        time_s,
        trial.preload + trial.setpoint,
        trial.preload + response,
        {
            "rise time": rise_text(known),
            "overshoot": share_text(known.overshoot),
            "sensitivity Ms": f"{Ms:.3g}",
            "phase margin": f"{phase_margin_deg:.0f}°",
        },
    )
