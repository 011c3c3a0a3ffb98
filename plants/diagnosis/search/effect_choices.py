"""The effects that a diagnosis chooses from."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.effects import Effect, declared, find


class EffectChoices(NamedTuple):
    """The effects to choose from.

    Attributes:
        structural: Those that are fitted.
        calibrations: Those that are a wrong number of the model as given.
        in_noise: Those found in the noise.
        in_torque: Those found in the balance of torques.
        unavailable: Why others cannot be added to this model, by slug.
        shown_by: The experiment that shows each of all, by slug.
    """

    structural: tuple[type[Effect], ...]
    calibrations: tuple[type[Effect], ...]
    in_noise: tuple[type[Effect], ...]
    in_torque: tuple[type[Effect], ...]
    unavailable: Mapping[str, str]
    shown_by: Mapping[str, str]

    @classmethod
    def of(
        cls, plant: DiagnosedModel, effects: Sequence[type[Effect] | str] | None
    ) -> "EffectChoices":
        """The effects asked for, classes or slugs, that this model can have; None is all."""
        asked = [find(e) if isinstance(e, str) else e for e in effects or ()]
        asked = list(declared()) if effects is None else asked
        reasons = {e.name: plant.unavailable(e) for e in asked}
        available = [e for e in asked if reasons[e.name] is None]
        return cls(
            structural=tuple(
                e for e in available if not (e.base_parameter or e.in_noise or e.in_torque)
            ),
            calibrations=tuple(e for e in available if e.base_parameter),
            in_noise=tuple(e for e in available if e.in_noise),
            in_torque=tuple(e for e in available if e.in_torque),
            unavailable={name: why for name, why in reasons.items() if why is not None},
            shown_by={e.name: e.excitation for e in asked},
        )
