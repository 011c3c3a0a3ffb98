"""Base class of the plant models: they take effects, run trials and serve as rigs."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import Field, dataclass, fields, replace
from functools import cached_property
from html import escape
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray, check_not_negative, check_positive
from estune.errors import InvalidInput
from estune.support.quantity_text import time_text
from estune.trial.description import UNLIMITED_N
from estune.trial.signals import REEL, Signals
from plants.effects import Effect
from plants.effects.plant_scale import PlantScale
from plants.models.parameters import amend_parameters
from plants.simulation.plant import Columns, Plant, TrialSetpoint, split_dead_time
from plants.simulation.simulated_rig import SimulatedRig
from plants.simulation.trial_loop import Batch, trial_loop


@dataclass(frozen=True, kw_only=True, repr=False)
class PlantModel(Plant, ABC):
    """A plant to which physical effects are added with `+`."""

    # The effects added, in the order in which the signal meets them.
    effects: tuple[Effect, ...] = ()
    # Relative standard deviations of own numbers, by field: how well their owner knows them.
    uncertainty: tuple[tuple[str, float], ...] = ()

    uncertain: ClassVar[tuple[str, ...]] = ()
    """Fields of which `uncertainty` may speak: those that a diagnosis fits."""

    rig_name: ClassVar[str] = "simulated-reel"
    """Name of its rig where no other is given."""

    diagnosed_by: ClassVar[str] = ""
    """Class that compares the model with records, a `plants.diagnosis.models.diagnosed_model.
    DiagnosedModel`, as module:attribute; empty where there is none."""

    @property
    def scale(self) -> PlantScale:
        """Words and sizes that sentences on the plant refer to."""
        return PlantScale(sampling_Hz=self.controller.sampling_Hz)

    @property
    def signals(self) -> Signals:
        """The plant's measured and commanded signals."""
        return REEL

    @property
    @abstractmethod
    def own_numbers(self) -> dict[str, float]:
        """The plant's own parameters by name."""

    @property
    @abstractmethod
    def structure(self) -> Any:
        """Structure of the equations, a `ParametricStructure`."""

    @abstractmethod
    def summary(self) -> str:
        """The plant's distinctive settings, for its repr."""

    def __repr__(self) -> str:
        added = "".join(f" + {effect!r}" for effect in self.effects)
        return f"{type(self).__name__}({self.summary()}){added}"

    def facts(self) -> dict[str, str]:
        """The plant's properties as a rig, by label."""
        signals, step, settings = self.signals, self.profile, self.controller
        low, high = settings.output_min_N, settings.output_max_N
        limits = f", {low:g} to {signals.commanded(high)}" if -low < UNLIMITED_N > high else ""
        noise = self.noise_rms_N
        start = f"{time_text(step.step_at_s)} of {time_text(step.duration_s)}"
        return {
            "measured": signals.measurement_name,
            "commanded": f"{signals.command_name}{limits}",
            "sampling": f"every {time_text(1.0 / settings.sampling_Hz)}",
            **({"noise": f"{signals.measured(noise)} rms"} if noise else {}),
            "suggested step": f"{signals.step_text(step)} at {start}",
            **{f"with {type(effect).title}": repr(effect) for effect in self.effects},
        }

    def _repr_html_(self) -> str:
        rows = [("", f"{type(self).__name__}({self.summary()})")]
        if self.profile.loop == "closed":
            rows += self.facts().items()
        cells = "".join(f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in rows)
        return f"<table>{cells}</table>"

    def __add__(self, effect: Effect) -> Self:
        """The plant with one more physical effect."""
        if not isinstance(effect, Effect):
            return NotImplemented
        return replace(self, effects=(*self.effects, effect))

    @property
    def kinds(self) -> tuple[type[Effect], ...]:
        """Types of the effects, without their parameters."""
        return tuple(type(effect) for effect in self.effects)

    @cached_property
    def amended_numbers(self) -> SimpleNamespace:
        """The plant's own parameters, as amended by the effects."""
        # A plant without a motor takes its torque as the command, and has its friction elsewhere.
        plain = {"viscous_friction_Nms": 0.0, "torque_constant_Nm_A": 1.0}
        pairs = [(type(e), SimpleNamespace(**vars(e))) for e in self.effects]
        return amend_parameters(SimpleNamespace(**plain | self.own_numbers), pairs)

    @cached_property
    def dead_time(self) -> tuple[int, float]:
        """Dead time with that of the effects: whole samples and the fraction of one."""
        p = self.amended_numbers
        return split_dead_time(p.dead_time_s, p.sampling_Hz)

    @property
    def delay_samples(self) -> int:
        """Whole samples of the dead time, with that of the effects."""
        return self.dead_time[0]

    @cached_property
    def parameter_values(self) -> FloatArray:
        """Values of the parameters: own, samples of dead time, those of the effects."""
        own = [self.own_numbers[name] for name in self.structure.own_names]
        added = [getattr(e, name) for e in self.effects for name in e.parameters()]
        return np.array([*own, self.delay_samples, *added])

    def admissible(self, drive: TrialSetpoint) -> TrialSetpoint:
        """The drive of a trial as the plant can take it; raises PlantError where it cannot."""
        return drive

    def respond(
        self,
        coefficients: FloatArray,
        drive: TrialSetpoint,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        drive = self.admissible(drive)
        batch = Batch(
            parameters=self.parameter_values,
            coefficients=coefficients,
            preload_N=drive.preload_N,
            setpoint_N=drive.setpoint_N,
            noise_N=noise_N,
            delay=self.delay_samples,
            bound_N=bound_N,
            open_loop=drive.open_loop,
            load_N=drive.load_N,
            compensation=drive.compensation,
        )
        return trial_loop(self.structure).run(batch)

    def rig(
        self,
        name: str | None = None,
        seed: int = 0,
        gains: Gains | None = None,
        pace: float = 0.0,
    ) -> SimulatedRig:
        """A rig in this process that runs the plant.

        Args:
            name: The rig's name; `rig_name` by default.
            seed: Seed of the measurement noise.
            gains: Initial live gains; None is the plant's own safe gains.
            pace: Wall-clock seconds per second of a trial; 0 is without waiting.

        Raises:
            InvalidInput: the seed or the pace is out of its range.
            UnsafeStart: no gains were given and no safe ones are known.
        """
        return SimulatedRig(self, name=name or self.rig_name, seed=seed, gains=gains, pace=pace)


def own_fields(kind: type[Any]) -> list[Field[Any]]:
    """The fields of a plant model that are numbers of its own."""
    return [f for f in fields(kind) if f.name not in ("effects", "uncertainty")]


def check_fields(plant: PlantModel, what: str, may_be_zero: tuple[str, ...]) -> None:
    """Checks that every field is a finite number above zero, or zero where that is allowed."""
    for f in own_fields(type(plant)):
        check = check_not_negative if f.name in may_be_zero else check_positive
        check(f"{what}: {f.name}", getattr(plant, f.name), "")


def check_field_names(kind: type[Any], what: str, names: Iterable[str]) -> None:
    """Checks that a plant model has fields of these names.

    Raises:
        InvalidInput: it has not.
    """
    known = {f.name for f in fields(kind)}
    for name in names:
        if name not in known:
            raise InvalidInput(f"{what} has no {name}; it has {', '.join(sorted(known))}")


def changed_fields(plant: PlantModel, always: tuple[str, ...] = ()) -> str:
    """The fields whose values differ from their defaults, and those named, as arguments."""
    return ", ".join(
        f"{f.name}={getattr(plant, f.name):g}"
        for f in own_fields(type(plant))
        if f.name in always or getattr(plant, f.name) != f.default
    )
