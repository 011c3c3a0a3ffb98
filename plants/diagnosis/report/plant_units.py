"""Results in the names and units of a plant that is no reel.

Effects are declared in a reel's units. A stage declares its own; of a plant known by input and
output alone `plants.models.linear_signal_path` defines the equivalents.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from plants.diagnosis.interval import Interval
from plants.diagnosis.residual.localisation import ResidualDependence, ResidualLocation
from plants.effects import Effect, Port, Role
from plants.effects.plant_scale import PlantScale
from plants.models.linear_signal_path import READINGS_PER_ANGLE, ARM_m


def in_own_units(effect: type[Effect], name: str, fitted: Interval, model: Any) -> Interval:
    """A parameter of an effect with its interval, in the model's own units.

    Args:
        effect: The effect's class.
        name: Name of the parameter.
        fitted: Its value and interval, in the declared unit.
        model: The model that was fitted; those of a reel are unchanged.
    """
    declared, scale = effect.parameters()[name], PlantScale.of(model)
    if declared.is_phase:
        return fitted
    units = _units(effect.port, model)
    size, unit = units.get(fitted.unit, (1.0, scale.unit(fitted.unit)))
    if declared.role is Role.PERIODS:
        # What turns by 2 pi a turn moves by so many metres, or units of a plant's output.
        radian, length = units.get("rad", (1.0, scale.unit("rad")))
        if length != "rad":
            size, unit = 1.0 / (2.0 * math.pi * radian), f"1/{length}"
    if declared.low >= 0.0:
        size = abs(size)
    low, high = sorted((fitted.low * size, fitted.high * size))
    return Interval(fitted.value * size, low, high, unit)


def own_names(
    effect: type[Effect], fitted: Mapping[str, Interval], scale: PlantScale
) -> dict[str, str]:
    """Names of an effect's parameters in the plant's own units, by those declared."""
    declared = effect.parameters()
    units = {name: "" if declared[name].is_phase else declared[name].unit for name in fitted}
    # Periods are of a turn, 1, or of a length, 1/m.
    return {
        name: scale.parameter(name, units[name], at.unit)
        if declared[name].role is not Role.PERIODS or not at.unit
        else name.replace("per_turn", f"per_{at.unit.removeprefix('1/')}")
        for name, at in fitted.items()
    }


def located_in_own_units(where: ResidualLocation, scale: PlantScale) -> ResidualLocation:
    """Location of a residual, in the plant's own units."""
    blocks = []
    for block in where.blocks:
        views = [
            replace(
                view,
                name=_detail(view.name, scale),
                unit=_view_unit(view, scale),
                detail=_detail(view.detail, scale),
            )
            for view in block.views
        ]
        # The balance of a plant is an effort.
        unit = scale.channel("current_A")[1] if scale.channels else scale.unit(block.unit)
        blocks.append(replace(block, unit=unit, views=tuple(views)))
    return replace(where, blocks=tuple(blocks), sentence=_detail(where.sentence, scale))


def _view_unit(view: ResidualDependence, scale: PlantScale) -> str:
    """Unit of the variable of a view; of a plant that of its command or measurement."""
    if not scale.channels:
        return scale.unit(view.unit)
    signal_unit = scale.input_unit if view.name == "command rate" else scale.output_unit
    return re.sub(r"^N\b", signal_unit, view.unit)


def _detail(text: str, scale: PlantScale) -> str:
    """A text in the plant's own words, with the length of a period in its unit."""
    title = scale.channel("tension_N")[0]
    text = text.replace("tension_N", title)
    if scale.channels:
        text = re.sub(r"\btension\b", title, text)
    return re.sub(r"(?<=\d) rad\b", f" {scale.unit('rad')}", text)


def _units(port: Port, model: Any) -> dict[str, tuple[float, str]]:
    """Factor from a unit to the plant's own, and its symbol; empty for a reel."""
    torque, angle = getattr(model, "torque_unit", None), getattr(model, "angle_unit", None)
    if torque is None or angle is None:
        return {}
    at_gauge = port is Port.GAUGE
    newton = angle / READINGS_PER_ANGLE if at_gauge else torque * ARM_m
    scale = PlantScale.of(model)
    input_unit, output_unit = scale.input_unit or "input", scale.output_unit or "output"
    read = output_unit if at_gauge else input_unit
    return {
        "N m": (torque, input_unit),
        "A": (torque, input_unit),
        "A/s": (torque, f"{input_unit}/s"),
        "rad": (abs(angle), output_unit),
        "rad/s": (abs(angle), f"{output_unit}/s"),
        "m": (abs(angle) / ARM_m, output_unit),
        "N m s/rad": (torque / abs(angle), f"{input_unit} s/{output_unit}"),
        "N m s2/rad2": (torque / angle**2, f"{input_unit} s2/{output_unit}2"),
        "N": (newton, read),
        "N/s": (newton, f"{read}/s"),
        "1/N": (1.0 / newton, f"1/{read}"),
        "1/N2": (1.0 / newton**2, f"1/{read}2"),
    }
