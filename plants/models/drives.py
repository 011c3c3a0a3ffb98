"""Servos and positioning stages, with numbers and units of their own.

The equations are those of a drum of radius 1 m, `J theta'' + b theta' = Kt i`: of a stage the
angle is a position in m, the inertia a mass, the torque a force. Fields have the drum's names;
tables of model files, results and sentences the plant's own.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from estune.core.quantities import check_not_negative, check_positive
from estune.trial import RigLimits
from estune.trial.description import UNLIMITED_N
from plants.effects.plant_scale import PlantScale
from plants.models.unloaded_reel import UnloadedReel

_MAY_BE_ZERO = ("viscous_friction_Nms", "dead_time_s")


@dataclass(frozen=True, repr=False)
class Servo(UnloadedReel):
    """A motor with its load, torque in and angle out; made by `servo`."""

    title = "servo"
    FIELDS: ClassVar[dict[str, str]] = {
        "inertia_kg_m2": "drum_inertia_kg_m2",
        "viscous_friction_Nms": "viscous_friction_Nms",
        "torque_constant_Nm_A": "torque_constant_Nm_A",
        "current_limit_A": "current_limit_A",
        "speed_max_rad_s": "speed_max_rad_s",
        "travel_max_rad": "travel_max_rad",
        "dead_time_s": "dead_time_s",
        "encoder_counts": "encoder_counts",
        "sampling_Hz": "sampling_Hz",
    }
    """Fields by the names of the model file's keys."""
    speed_max_rad_s: float = UNLIMITED_N
    travel_max_rad: float = UNLIMITED_N

    @property
    def limits(self) -> RigLimits:
        return replace(
            super().limits,
            speed_max_rad_s=self.speed_max_rad_s,
            travel_max_rad=self.travel_max_rad,
        )

    @property
    def scale(self) -> PlantScale:
        names = {"drum_inertia_kg_m2": "inertia_kg_m2"}
        return super().scale._replace(subject=self.title, names=names)

    @property
    def own_values(self) -> dict[str, float]:
        """The values of the model file's keys."""
        return {key: getattr(self, name) for key, name in self.FIELDS.items()}

    def summary(self) -> str:
        """The values of the model file's keys but limits that are none and zeros."""
        values = self.own_values.items()
        return ", ".join(f"{key}={value:g}" for key, value in values if 0.0 < value < UNLIMITED_N)


@dataclass(frozen=True, repr=False)
class Stage(Servo):
    """A carriage on a guide, force in and position out; made by `stage`."""

    title = "stage"
    FIELDS: ClassVar[dict[str, str]] = {
        "mass_kg": "drum_inertia_kg_m2",
        "viscous_friction_Ns_m": "viscous_friction_Nms",
        "force_constant_N_A": "torque_constant_Nm_A",
        "current_limit_A": "current_limit_A",
        "speed_max_m_s": "speed_max_rad_s",
        "travel_max_m": "travel_max_rad",
        "dead_time_s": "dead_time_s",
        "encoder_step_m": "encoder_counts",
        "sampling_Hz": "sampling_Hz",
    }

    @property
    def scale(self) -> PlantScale:
        units = {
            "N m": "N",
            "rad": "m",
            "rad/s": "m/s",
            "N m s/rad": "N s/m",
            "N m s2/rad2": "N s2/m2",
            "kg m2": "kg",
        }
        if self.torque_constant_Nm_A == 1.0:  # the command is a force
            units |= {"A": "N", "A/s": "N/s"}
        names = {
            "drum_inertia_kg_m2": "mass_kg",
            "viscous_friction_Nms": "viscous_friction_Ns_m",
            "torque_offset_Nm": "force_offset_N",
            "angle_rad": "position_m",
        }
        return super().scale._replace(subject=self.title, units=units, names=names)

    @property
    def own_values(self) -> dict[str, float]:
        return super().own_values | {"encoder_step_m": 2.0 * math.pi / self.encoder_counts}


def servo(
    inertia_kg_m2: float,
    viscous_friction_Nms: float,
    *,
    torque_constant_Nm_A: float = 1.0,
    current_limit_A: float = UNLIMITED_N,
    speed_max_rad_s: float = UNLIMITED_N,
    travel_max_rad: float = UNLIMITED_N,
    dead_time_s: float = 0.0,
    encoder_counts: float = 2.0**20,
    sampling_Hz: float = 1000.0,
) -> Servo:
    """A servo: `J theta'' + b theta' = Kt i`.

    Args:
        inertia_kg_m2: Inertia J of motor and load, kg m2.
        viscous_friction_Nms: Viscous friction b, N m s/rad.
        torque_constant_Nm_A: Torque per current Kt, N m/A; 1 where the command is a torque.
        current_limit_A: Maximum magnitude of the current, A; none by default.
        speed_max_rad_s: Greatest speed in experiments, rad/s; none by default.
        travel_max_rad: Longest way in experiments, rad; none by default.
        dead_time_s: Dead time from command to torque, s.
        encoder_counts: Encoder counts per turn.
        sampling_Hz: Sampling rate, Hz.

    Raises:
        InvalidInput: a value is out of its range.
    """
    made: Servo = _made(Servo, locals())
    return made


def stage(
    mass_kg: float,
    viscous_friction_Ns_m: float,
    *,
    force_constant_N_A: float = 1.0,
    current_limit_A: float = UNLIMITED_N,
    speed_max_m_s: float = UNLIMITED_N,
    travel_max_m: float = UNLIMITED_N,
    dead_time_s: float = 0.0,
    encoder_step_m: float = 1e-6,
    sampling_Hz: float = 1000.0,
) -> Stage:
    """A positioning stage: `M x'' + b x' = Kf i`.

    Args:
        mass_kg: Mass M, of what turns with it, too, kg.
        viscous_friction_Ns_m: Viscous friction b, N s/m.
        force_constant_N_A: Force per current Kf, N/A; 1 where the command is a force.
        current_limit_A: Maximum magnitude of the current, A; none by default.
        speed_max_m_s: Greatest speed in experiments, m/s; none by default.
        travel_max_m: Longest way in experiments, m; none by default.
        dead_time_s: Dead time from command to force, s.
        encoder_step_m: Step of the position read, m.
        sampling_Hz: Sampling rate, Hz.

    Raises:
        InvalidInput: a value is out of its range.
    """
    made: Stage = _made(Stage, locals())
    return made


def _made(kind: type[Any], values: dict[str, Any]) -> Any:
    """A drive from the values of its keys."""
    for key, value in values.items():
        check = check_not_negative if kind.FIELDS[key] in _MAY_BE_ZERO else check_positive
        check(f"{kind.title}: {key}", value, "")
    if "encoder_step_m" in values:
        values |= {"encoder_step_m": 2.0 * math.pi / values["encoder_step_m"]}
    return kind(drum_radius_m=1.0, **{kind.FIELDS[key]: value for key, value in values.items()})
