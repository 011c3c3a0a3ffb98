"""Data of the tuning page: the loop identified from a run, its uncertainty, and what was tried."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from estune.core.gains import GAIN_NAMES, Gains
from estune.loop_model.drawn_models import drawn_models, white_factor
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import LoopModel
from estune.loop_model.optimum import SENSITIVITY_MAX, RobustnessLimits
from estune.loop_model.problem import problem
from estune.run.planning import step_trial
from estune.run.results.run_result import RunResult
from estune.support.quantity_text import axis_label
from estune.trial import RigDescription, TrialRecord
from estune.tuners import SearchSpace

DRAWS = 40
"""Models in the band: all of them lie within it, 95 % of further ones in the mean."""
SAMPLES_MAX = 60_000
"""Samples that all models have together: a move of a slider simulates them anew."""
DRAWS_MIN = 8
CURVES = 12
"""Trials whose response is shown where they are nearest."""
WIDEST = 100.0
"""Factor from the initial gains to the ends of a slider, where the tuned ones lie no further."""
POINTS = 200
"""Points of such a response."""


def tuning_data(result: RunResult) -> dict[str, Any] | None:
    """The data of the tuning page as JSON values; None where no loop was identified."""
    loop, plan, rig = result.identified, result.plan, result.rig
    if loop.fit is None:
        return None
    rest = float(np.mean([step.signals.rest_effort for step in loop.steps]))
    trial = replace(step_trial(rig, plan.step, plan.cost), rest_effort=rest)
    models = [loop.fit.model, *_draws(loop.fit, trial.samples)]
    limits = plan.limits or RobustnessLimits()
    space = plan.tuner.space
    gain = loop.fit.model.static_gain
    records = {step.record.gains: step.record for step in loop.steps}
    return problem(models, trial, loop.fit.noise_std) | {
        "known": _known(result),
        "settling_s": plan.cost.settling_time_s,
        "static_gain": gain if math.isfinite(gain) else 0.0,
        "preload": plan.step.preload_N,
        "measurement": rig.measurement,
        "measurement_deviation": f"deviation of the {rig.measurement}",
        "measurement_limits": _finite(rig.limits.tension_min_N, rig.limits.tension_max_N),
        "command": rig.command,
        "command_unit": rig.command.rpartition(", ")[2] if ", " in rig.command else "",
        "labels": _labels(rig),
        "tuned": [name for name, value in _values(result.start_gains).items() if value > 0.0],
        "bounds": _bounds(space, result.start_gains, result.gains),
        "limits": {
            "Ms": limits.max_sensitivity or SENSITIVITY_MAX,
            "overshoot": 0.05 if limits.max_overshoot is None else limits.max_overshoot,
            "phase_margin_deg": limits.min_phase_margin_deg,
        },
        "gains": {
            "initial": _values(result.start_gains),
            "tuned": _values(result.gains) if result.success else None,
        },
        "tried": [
            {"gains": _values(gains)} | _curve(record, rig) for gains, record in records.items()
        ][-CURVES:],
    }


def _known(result: RunResult) -> str:
    """What the predictions rest on, in a sentence."""
    loop, claim = result.identified, result.claim
    source = f"Predicted by the loop identified from the last {len(loop.signals)} trials"
    if claim.margins is None and claim.reason:
        return f"{source}. Nothing is claimed of it: {claim.reason}."
    return f"{source}; its model leaves {claim.misfit:.2%} of the step unexplained."


def _draws(fit: LoopFit, samples: int) -> list[LoopModel]:
    """Models that the records allow, by the covariance of the fit."""
    count = min(DRAWS, max(DRAWS_MIN, SAMPLES_MAX // samples))
    # A fixed seed: the same run gives the same page.
    return list(drawn_models(fit, white_factor(fit), count, seed=0))


def _labels(rig: RigDescription) -> dict[str, str]:
    return {
        name: axis_label(name.removesuffix("_s").replace("_", " "), unit)
        for name, unit in rig.gain_units.items()
    }


def _values(gains: Gains) -> dict[str, float]:
    return dict(zip(GAIN_NAMES, gains.as_tuple(), strict=True))


def _bounds(space: SearchSpace, start: Gains, tuned: Gains) -> dict[str, dict[str, float]]:
    """Ends of the sliders: within the bounds of the search, and with the tuned gains."""
    first, last = _values(start), _values(tuned)
    low = {name: min(value / WIDEST, last[name]) for name, value in first.items()}
    high = {name: max(value * WIDEST, last[name]) for name, value in first.items()}
    if space.form == "parallel":
        for name, least, most in zip(space.names, space.low, space.high, strict=True):
            low[name] = max(low[name], least)
            high[name] = min(high[name], most) if first[name] else most
    return {"low": low, "high": high}


def _finite(*limits: float) -> list[float | None]:
    return [limit if math.isfinite(limit) else None for limit in limits]


def _curve(record: TrialRecord, rig: RigDescription) -> dict[str, Any]:
    every = max(1, math.ceil(record.time_s.size / POINTS))
    command = record.current_A * rig.newtons_per_ampere
    columns = {"y": record.tension_N, "u": command}
    return {"every": every} | {
        name: [float(f"{value:.5g}") for value in column[::every].tolist()]
        for name, column in columns.items()
    }
