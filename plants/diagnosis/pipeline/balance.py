"""The judgement of the torque balance on the records of a fit, and a model with its values."""

from collections.abc import Sequence

import numpy as np

from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.models.free_parameters import BASE
from plants.diagnosis.pipeline.fit import BaseFit
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.torque_balance.agreement import VISIBLE, family_of
from plants.diagnosis.torque_balance.balance import INERTIA, OFFSET, VISCOUS, torque_balance
from plants.diagnosis.torque_balance.judge import TorqueJudgement, judge
from plants.effects import EFFECTS, Effect
from plants.effects.plant_scale import PlantScale

ZERO = "encoder_zero_rad["
NARROWER = 0.25
"""Kernel with which values are compared, relative to the widest. Mass and Coulomb friction of a
measured stage move by 2 % with it, and inverse dynamics with a filter of 100 Hz by as much."""


def judgement(fitted: BaseFit) -> TorqueJudgement | None:
    """What the balance of torques says; None where it cannot be judged.

    It is of a drive that nothing holds, whose declared effects are all laws of a torque. All laws
    are looked at, whatever the search may choose from: another one in the place of the one that is
    there would be a wrong name.
    """
    plant = fitted.plant
    numbers = [BaseNumbers.of(plant.model, m) for m in plant.measurements]
    free = [b for b in numbers if b is not None and b.is_free]
    declared = [type(effect) for effect in plant.effects]
    if len(free) < len(numbers) or any(family_of(e) not in VISIBLE for e in declared):
        return None
    noise_rad = fitted.noise.angle_rad
    balance = torque_balance(plant.measurements, free, noise_rad)
    narrower = torque_balance(plant.measurements, free, noise_rad, NARROWER)
    if balance is None:
        return None
    turns = PlantScale.of(plant.model).unit("rad") == "rad"
    of_torque = [e for e in EFFECTS.values() if family_of(e) in VISIBLE]
    looked = [e for e in of_torque if turns or e.name != "link_gravity"]
    judged = judge(balance, looked, declared, narrower)
    offered = all(effect in fitted.choices.structural for effect in judged.effects)
    return judged if offered else None


def with_values(
    fitter: ModelFitter, effects: Sequence[type[Effect]], judged: TorqueJudgement, *, sized: bool
) -> CandidateFit:
    """The model with effects as the balance has them.

    Args:
        fitter: Model and records.
        effects: The effects.
        judged: What the balance says.
        sized: Whether a prediction that names a part of them sizes them all; otherwise only values
            of single records are fitted.
    """
    predictor = fitter.predictor(tuple(effects))
    base = {
        "drum_inertia_kg_m2": judged.base[INERTIA].value,
        "viscous_friction_Nms": judged.base[VISCOUS].value,
        "torque_offset_Nm": -judged.base[OFFSET].value,
    }
    zeros = [f.name for f in predictor.free if f.name.startswith(ZERO)]
    values = {name: at.value for name, at in judged.values.items()} | base
    row = predictor.row(values | dict.fromkeys(zeros, 0.0))
    # A friction that is not told from zero may come out below.
    least = [f.low if f.owner == BASE else -np.inf for f in predictor.free]
    row = np.maximum(row, least)
    if sized:
        return fitter.final(fitter.fit(tuple(effects), row))
    return fitter.fit(tuple(effects), row, owners=frozenset(), held=zeros)
