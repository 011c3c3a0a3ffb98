"""Simulated plants: the reference reel, any linear model, any Python function.

reel = plants.reference_reel(cable_length_m=0.8, tension_N=15.0)
result = estune.tune(reel)
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plants.discrepancy.explain import explain
    from plants.discrepancy.improve import improve
    from plants.effects import CoulombFriction, Effect
    from plants.function import PythonPlant, python_plant
    from plants.linear import LinearPlant, linear_plant
    from plants.model_file import load_model, save_model
    from plants.moving import simulate_moving
    from plants.plant import Plant
    from plants.reel import Reel, reference_reel
    from plants.rig import SimulatedRig
    from plants.simulation import Response, batch_costs, simulate
    from plants.unloaded import UnloadedReel, unloaded_reel

__all__ = [
    "CoulombFriction",
    "Effect",
    "LinearPlant",
    "Plant",
    "PythonPlant",
    "Reel",
    "Response",
    "SimulatedRig",
    "UnloadedReel",
    "batch_costs",
    "explain",
    "improve",
    "linear_plant",
    "load_model",
    "python_plant",
    "reference_reel",
    "save_model",
    "simulate",
    "simulate_moving",
    "unloaded_reel",
]

_HOMES = {
    "CoulombFriction": "plants.effects",
    "Effect": "plants.effects",
    "LinearPlant": "plants.linear",
    "Plant": "plants.plant",
    "PythonPlant": "plants.function",
    "Reel": "plants.reel",
    "Response": "plants.simulation",
    "SimulatedRig": "plants.rig",
    "UnloadedReel": "plants.unloaded",
    "batch_costs": "plants.simulation",
    "explain": "plants.discrepancy.explain",
    "improve": "plants.discrepancy.improve",
    "linear_plant": "plants.linear",
    "load_model": "plants.model_file",
    "python_plant": "plants.function",
    "reference_reel": "plants.reel",
    "save_model": "plants.model_file",
    "simulate": "plants.simulation",
    "simulate_moving": "plants.moving",
    "unloaded_reel": "plants.unloaded",
}


def __getattr__(name: str) -> Any:
    """Loads a public name when it is first used, so that the command line starts quickly."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
