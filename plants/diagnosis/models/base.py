"""The base model at one record, as plain numbers."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.trial import LinearModel
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.models.linear_plant import LinearPlant
from plants.models.reel import Reel
from plants.models.reel_equations import cable_stiffness_N_m, viscous_friction_Nms
from plants.models.unloaded_reel import UnloadedReel

_DRUM = (
    "dead_time_s",
    "drum_radius_m",
    "drum_inertia_kg_m2",
    "viscous_friction_Nms",
    "current_limit_A",
)


@dataclass(frozen=True, slots=True)
class BaseNumbers:
    """Parameters of the plant while one record was measured, without any effect.

    A reel has a radius, an inertia and a stiffness; one without cable has no stiffness and no
    tension; any other plant is a linear model from effort to its output.

    Attributes:
        newtons_per_ampere: Effort per motor current, N/A: torque constant over radius.
        dead_time_s: From the command to the torque, s.
        drum_radius_m: Radius on which the cable lies, m.
        viscous_friction_Nms: Friction at the record's cable length, N m s/rad.
        stiffness_N_m: Of the cable at the record's length and preload, N/m; None without cable.
        gauge_Hz: Natural frequency of the gauge, Hz; None where it follows at once.
        gauge_damping: Its damping ratio.
        current_limit_A: Greatest size of the current, A; infinite where it is not known.
        linear: The plant, where it is not a reel.
    """

    newtons_per_ampere: float
    sampling_Hz: float
    dead_time_s: float = 0.0
    drum_radius_m: float = 1.0
    drum_inertia_kg_m2: float = 1.0
    viscous_friction_Nms: float = 0.0
    stiffness_N_m: float | None = None
    gauge_Hz: float | None = None
    gauge_damping: float = 0.0
    current_limit_A: float = float("inf")
    linear: LinearModel | None = None

    @classmethod
    def of(cls, model: Any, measurement: MeasuredRecord) -> "BaseNumbers | None":
        """The numbers of a model at a record's cable length and preload.

        Returns:
            None where the model has no such numbers: a plant that is known as a function only.
        """
        if isinstance(model, Reel):
            return cls._of_reel(model, measurement)
        if isinstance(model, UnloadedReel):
            drum = {name: getattr(model, name) for name in _DRUM}
            return cls(model.newtons_per_ampere, measurement.sampling_Hz, **drum)
        linear = model.model if isinstance(model, LinearPlant) else None
        if linear is None:
            return None
        dead_time_s = linear.dead_time_s
        return cls(model.newtons_per_ampere, measurement.sampling_Hz, dead_time_s, linear=linear)

    @classmethod
    def _of_reel(cls, model: Reel, measurement: MeasuredRecord) -> "BaseNumbers":
        # Not below what the model is for: the sag's share of the flexibility has a pole at zero.
        preload_N = max(measurement.preload_N, model.tension_min_N)
        length_m = measurement.cable_length_m
        reel = model if length_m is None else replace(model, cable_length_m=length_m)
        drum = {name: getattr(reel, name) for name in _DRUM}
        drum["viscous_friction_Nms"] = viscous_friction_Nms(reel)
        return cls(
            reel.newtons_per_ampere,
            measurement.sampling_Hz,
            stiffness_N_m=cable_stiffness_N_m(reel, preload_N),
            gauge_Hz=reel.gauge_Hz,
            gauge_damping=reel.gauge_damping,
            **drum,
        )

    @property
    def tension_per_angle_N_rad(self) -> float:
        """Tension per angle of the cable, k R; nan without a cable."""
        return (self.stiffness_N_m or math.nan) * self.drum_radius_m

    @property
    def is_free(self) -> bool:
        """Whether it is an inertia with friction alone, which nothing holds."""
        return self.linear is None and self.stiffness_N_m is None

    @property
    def slowest_s(self) -> float:
        """Time constant of the slowest mode that dies away, s; 0 where none does."""
        rates = -np.asarray(self._poles().real)
        dying = rates[rates > 1e-6 * max(self._slow_rad_s, float(np.abs(rates).max(initial=0.0)))]
        return float(1.0 / dying.min()) if dying.size else 0.0

    @property
    def natural_rad_s(self) -> float:
        """Size of the slowest pole that is not at zero, rad/s; 0 where there is none."""
        sizes = np.abs(self._poles())
        moving = sizes[sizes > 1e-9 * sizes.max(initial=0.0)]
        return float(moving.min()) if moving.size else 0.0

    @property
    def integrates(self) -> bool:
        """Whether a constant effort moves it without end."""
        poles = self._poles()
        size = max(self._slow_rad_s, float(np.abs(poles).max(initial=0.0)))
        return bool(np.any(poles.real >= -1e-9 * size))

    @property
    def _slow_rad_s(self) -> float:
        """A rate beside which a millionth is zero: no record has 1e8 samples."""
        return 0.01 * self.sampling_Hz

    def _poles(self) -> NDArray[np.complex128]:
        if self.linear is not None:
            n = len(self.linear.B)
            return np.linalg.eigvals(np.reshape(self.linear.A, (n, n))).astype(np.complex128)
        J, b = self.drum_inertia_kg_m2, self.viscous_friction_Nms
        k = (self.stiffness_N_m or 0.0) * self.drum_radius_m**2
        return np.roots([J, b, k]).astype(np.complex128)
