"""The prediction problem of an identified loop as JSON values, for `browser/loop.js`."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from estune.core.controller_form import OWN_FORM
from estune.core.pidf import ControllerSettings
from estune.core.response import StepShape
from estune.loop_model.model import LoopModel, law_basis
from estune.loop_model.prediction import StepTrial, fixed_noise

DIGITS = 10
"""Digits of the numbers that enter a recursion."""


def problem(models: Sequence[LoopModel], trial: StepTrial, noise_std: float) -> dict[str, Any]:
    """What `predict` of `browser/loop.js` takes.

    Args:
        models: The loop as it is estimated, then models that are as likely.
        noise_std: Standard deviation of the measurement noise.
    """
    cost, step, rate = trial.cost, trial.step, trial.controller.sampling_Hz
    weights: dict[str, Any] = {"unknown": bool(cost.function)}
    if not cost.function:
        weights |= {
            "error": _rounded(cost.weights(rate, step, trial.end)),
            "absolute": cost.criterion == "itae",
            "move": cost.move_weight,
            "effort": cost.effort_weight / (rate * cost.settling_time_s),
            "rejection": cost.rejection,
        }
    if step.load and cost.rejection and not cost.function:
        alone = StepShape(step.load.sample, step.load.size)
        weights["load_error"] = _rounded(cost.weights(rate, alone, trial.samples))
    by_variance = cost.is_quadratic and step.load is None
    return {
        "models": [_model(model) for model in models],
        "controller": _controller(trial.controller),
        "rest": trial.rest_effort,
        "trial": {
            "samples": trial.samples,
            "step_index": step.sample,
            "step_size": step.size,
            "ramp": step.ramp,
            "load_size": step.load.size if step.load else 0.0,
            "load_index": step.load.sample if step.load else trial.samples,
        },
        "cost": weights,
        "noise_std": noise_std,
        "noise": None if by_variance or not noise_std else _rounded(fixed_noise(trial.samples)),
    }


def _model(model: LoopModel) -> dict[str, Any]:
    return {
        "sections": [np.resize([*s.powers, 0.0], 3).tolist() for s in model.sections],
        "numerator": list(model.numerator),
        "dead_samples": model.dead_samples,
        "friction": model.friction,
    }


def _controller(settings: ControllerSettings) -> dict[str, Any]:
    """S and T as sums over P, I, D and I D / P, which is what every form of controller is."""
    (T, S), R = law_basis(settings)
    form = settings.form or OWN_FORM
    return {
        "sampling_Hz": settings.sampling_Hz,
        "derivative_filter_s": settings.derivative_filter_s,
        "limits": [
            limit if math.isfinite(limit) else None
            for limit in (settings.output_min_N, settings.output_max_N)
        ],
        "own": form == OWN_FORM,
        "S": S.tolist(),
        "T": T.tolist(),
        "R": R.tolist(),
        "setpoint_filter": form.setpoint_filter,
    }


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in np.asarray(values).tolist()]
