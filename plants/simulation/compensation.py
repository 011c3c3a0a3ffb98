"""Compensations of a simulated trial: the text that runs on hardware, beside its controller."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.hardware.compensation.plan import CompensationPlan
from estune.hardware.compensation.runtime import CompiledCompensation, PlainCompensation
from estune.hardware.compensation.source import compensation_source
from estune.hardware.compensation.tables import CompensationTable
from estune.hardware.scales import CurrentScale

ENCODER_COUNTS = 8192.0
"""Of which a tenth of one is the presliding distance where none is given."""
_EXACT = CurrentScale((0.0, 1.0), 0.0, 1.0, 1e9)
"""C1 of a simulated drive, whose current is as commanded."""


class TrialCompensation:
    """The compensations of trials.

    Attributes:
        plan: What they are.
    """

    def __init__(self, plan: CompensationPlan) -> None:
        self.plan = plan

    @cached_property
    def _source(self) -> str:
        return compensation_source(self.plan, _EXACT, 1.0)

    def compiled(self) -> CompiledCompensation:
        """Them at their start, as the C text for firmware.

        Raises:
            PlantError: no compiler, or it failed.
        """
        return CompiledCompensation(self._source)

    def plain(self) -> PlainCompensation:
        """Them at their start, in Python."""
        return PlainCompensation(self.plan)


def trial_compensation(
    table: CompensationTable, scale: Any, settings: ControllerSettings, name: str
) -> TrialCompensation:
    """The compensations of a table on a simulated reel.

    Args:
        scale: Sizes of the plant, `plants.effects.plant_scale.PlantScale`.
        settings: The fixed part of the controller.
        name: What the plant is called in a message.

    Raises:
        InvalidInput: the plant is no reel, or the table has what a simulation has not.
    """
    if scale is None or not scale.has_cable or table.gravity or table.known_motion:
        raise InvalidInput(
            f"{name} is simulated: it has compensations on a reel alone, and no far end that "
            "moves or has a height; leave gravity and known_motion out"
        )
    plan = table.plan(
        *(settings.sampling_Hz, ENCODER_COUNTS, scale.radius_m, scale.length_m),
        settings.output_max_N,
        newtons_per_ampere=scale.newtons_per_ampere,
    )
    return TrialCompensation(plan)


def compensation_of(
    tables: Mapping[str, Mapping[str, Any]], scale: Any, settings: ControllerSettings
) -> TrialCompensation | None:
    """The compensations of a remedy's tables; None for no tables."""
    if not tables:
        return None
    table = CompensationTable.model_validate({name: dict(one) for name, one in tables.items()})
    return trial_compensation(table, scale, settings, "the model")
