"""An FMU as a plant of a simulated rig."""

import logging
from dataclasses import dataclass, fields
from typing import Any

from plants.effects import Effect
from plants.models.fmu.step import FmuStep
from plants.models.python_plant import PythonPlant, python_plant

_log = logging.getLogger(__name__)


@dataclass(frozen=True, repr=False)
class FmuPlant(PythonPlant):
    """A plant given as an FMU; made by `fmu_plant`. It takes no effects.

    Attributes:
        step: The unit.
    """

    step: FmuStep

    @property
    def stated_dead_time_s(self) -> float:
        """Dead time as stated, before a tool's own step was taken out, s."""
        own_s = 1.0 / self.controller.sampling_Hz if self.step.facts().extra_step else 0.0
        return self.dead_time_s + own_s

    def unavailable(self, effect: type[Effect]) -> str | None:  # noqa: ARG002  of every effect
        return "an FMU is compiled, and takes no effects"

    def summary(self) -> str:
        """File, FMI version, tool and rate."""
        facts = self.step.facts()
        late = ", outputs one step late" if facts.extra_step else ""
        rate = f"{self.controller.sampling_Hz:g} Hz"
        return f"{self.step.file}, FMI {facts.version} by {facts.tool}{late}, {rate}"


def fmu_plant(
    file: str,
    *,
    input: str,  # noqa: A002  the word of the FMI standard
    output: str,
    sampling_Hz: float,
    dead_time_s: float = 0.0,
    **settings: Any,
) -> FmuPlant:
    """A plant from an FMU for co-simulation, FMI 2 or 3; FMPy is required.

    The unit makes one communication step per sample. Where its tool adds a step of delay, as
    Simulink does, that step is taken out of the dead time, so that the loop has the plant's own.

    Args:
        file: The `.fmu` file.
        input: Name of its variable that takes the effort.
        output: Name of its variable that is measured.
        sampling_Hz: Rate of the controller, and of the unit's communication.
        dead_time_s: Dead time of the plant that the unit does not have in itself, s.
        **settings: As of `plants.python_plant`: `settling_time_s`, gains, limits and so on.

    Raises:
        InvalidInput: the unit cannot be used, or a value is out of its range.
    """
    step = FmuStep(file, input, output)
    facts, sample_s = step.facts(), 1.0 / sampling_Hz
    if facts.extra_step:
        left_s = max(dead_time_s - sample_s, 0.0)
        _log.warning(
            "%s: %s adds one step of delay, %.4g s; the dead time of %.4g s is simulated as %.4g "
            "s beside it%s",
            *(file, facts.tool, sample_s, dead_time_s, left_s),
            "" if dead_time_s >= sample_s else ": the loop has more delay than the plant",
        )
        dead_time_s = left_s
    start = {"initial_measurement_N": facts.initial, **settings}
    plant = python_plant(step, 0.0, sampling_Hz=sampling_Hz, dead_time_s=dead_time_s, **start)
    return FmuPlant(**{f.name: getattr(plant, f.name) for f in fields(plant)})
