"""Simulated plants: the reference reel, any linear model, any Python function.

In two lines::

    reel = plants.reference_reel(cable_length_m=0.8, tension_N=15.0)
    result = estune.tune(reel)
"""

from typing import TYPE_CHECKING

from estune.support.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from plants.bench.moving_cable_end import simulate_moving
    from plants.diagnosis.experiments.designs import initial_experiments
    from plants.diagnosis.explain import explain
    from plants.effects import CoulombFriction, Effect, EyeletFriction
    from plants.improvement.improve import improve
    from plants.models.drives import Servo, Stage, servo, stage
    from plants.models.fmu.plant import FmuPlant, fmu_plant
    from plants.models.linear_plant import LinearPlant, linear_plant
    from plants.models.model_file import load_model, save_model
    from plants.models.python_plant import PythonPlant, python_plant
    from plants.models.reel import Reel, reference_reel
    from plants.models.unloaded_reel import UnloadedReel, unloaded_reel
    from plants.simulation.batch import Response, batch_costs, simulate
    from plants.simulation.plant import Plant
    from plants.simulation.simulated_rig import SimulatedRig

__all__ = [
    "CoulombFriction",
    "Effect",
    "EyeletFriction",
    "FmuPlant",
    "LinearPlant",
    "Plant",
    "PythonPlant",
    "Reel",
    "Response",
    "Servo",
    "SimulatedRig",
    "Stage",
    "UnloadedReel",
    "batch_costs",
    "explain",
    "fmu_plant",
    "improve",
    "initial_experiments",
    "linear_plant",
    "load_model",
    "python_plant",
    "reference_reel",
    "save_model",
    "servo",
    "simulate",
    "simulate_moving",
    "stage",
    "unloaded_reel",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "plants.bench.moving_cable_end": ("simulate_moving",),
        "plants.diagnosis.experiments.designs": ("initial_experiments",),
        "plants.diagnosis.explain": ("explain",),
        "plants.effects": ("CoulombFriction", "Effect", "EyeletFriction"),
        "plants.improvement.improve": ("improve",),
        "plants.models.drives": ("Servo", "Stage", "servo", "stage"),
        "plants.models.fmu.plant": ("FmuPlant", "fmu_plant"),
        "plants.models.linear_plant": ("LinearPlant", "linear_plant"),
        "plants.models.model_file": ("load_model", "save_model"),
        "plants.models.python_plant": ("PythonPlant", "python_plant"),
        "plants.models.reel": ("Reel", "reference_reel"),
        "plants.models.unloaded_reel": ("UnloadedReel", "unloaded_reel"),
        "plants.simulation.batch": ("Response", "batch_costs", "simulate"),
        "plants.simulation.plant": ("Plant",),
        "plants.simulation.simulated_rig": ("SimulatedRig",),
    },
)
