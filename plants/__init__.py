"""Simulated plants: the reference reel, any linear model, any Python function.

reel = plants.reference_reel(cable_length_m=0.8, tension_N=15.0)
result = estune.tune(reel)
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plants.effects import CoulombFriction, Effect
    from plants.linear_plant import LinearPlant, linear_plant
    from plants.plant import Plant
    from plants.python_plant import PythonPlant, python_plant
    from plants.reel import Reel, reference_reel
    from plants.rig import SimulatedRig
    from plants.simulate import Response, batch_costs, simulate

__all__ = [
    "CoulombFriction",
    "Effect",
    "LinearPlant",
    "Plant",
    "PythonPlant",
    "Reel",
    "Response",
    "SimulatedRig",
    "batch_costs",
    "linear_plant",
    "python_plant",
    "reference_reel",
    "simulate",
]

_HOMES = {
    "CoulombFriction": "plants.effects",
    "Effect": "plants.effects",
    "LinearPlant": "plants.linear_plant",
    "Plant": "plants.plant",
    "PythonPlant": "plants.python_plant",
    "Reel": "plants.reel",
    "Response": "plants.simulate",
    "SimulatedRig": "plants.rig",
    "batch_costs": "plants.simulate",
    "linear_plant": "plants.linear_plant",
    "python_plant": "plants.python_plant",
    "reference_reel": "plants.reel",
    "simulate": "plants.simulate",
}


def __getattr__(name: str) -> Any:
    """Loads a public name when it is first used, so that the command line starts quickly."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
