"""Whether records support the effects that a model declares already."""

import math
from collections.abc import Mapping
from dataclasses import replace

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.interval import Interval
from plants.diagnosis.models.diagnosed_model import DiagnosedModel, diagnosed
from plants.diagnosis.report.plant_units import in_own_units
from plants.diagnosis.result import DeclaredEffect, explained_share
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.effects import Effect


def declared_effects(
    plant: DiagnosedModel,
    noise: NoiseFloor,
    base: CandidateFit,
    fitted: Mapping[str, Interval],
) -> tuple[DeclaredEffect, ...]:
    """The effects of the model as given, each compared with a fit of the model without it.

    An effect is supported by the rule by which one is found: it takes off so much of the error
    power that the model without it leaves.
    """
    listed = []
    for n, effect in enumerate(plant.effects):
        others = (*plant.effects[:n], *plant.effects[n + 1 :], plant.calibration)
        without = diagnosed(replace(plant.model, effects=others), plant.measurements)
        fitter = ModelFitter(without, plant.measurements, noise)
        listed.append(_declared(type(effect), fitter.base_fit().J, base.J, fitted, plant))
    return tuple(listed)


def _declared(
    effect: type[Effect],
    without: float,
    with_it: float,
    fitted: Mapping[str, Interval],
    plant: DiagnosedModel,
) -> DeclaredEffect:
    explained = explained_share(without, with_it)
    supported = without > CONSTANTS.floor and explained >= CONSTANTS.one_more
    floors = math.sqrt(without), math.sqrt(with_it)
    ratios = "{:.3g} times the noise floor without it, {:.3g} with".format(*floors)
    verdict = "is supported by" if supported else "is not supported by"
    parameters = {
        name: in_own_units(effect, name, fitted[f"{effect.name}.{name}"], plant.model)
        for name in effect.parameters()
        if f"{effect.name}.{name}" in fitted
    }
    sentence = f"{effect.title}, which the model declares, {verdict} these records: {ratios}"
    return DeclaredEffect(effect.name, effect.title, parameters, supported, explained, sentence)
