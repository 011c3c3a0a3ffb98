"""The tables of a rig's file that switch compensations on."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from estune.errors import InvalidInput
from estune.hardware.compensation.plan import (
    AngleMap,
    CompensationPlan,
    EyeletFeedForward,
    Gravity,
    Notch,
    Wave,
)
from estune.hardware.tables import FileOrNumbers, NotNegative, Positive
from estune.reel.friction import FRACTION_MAX, FrictionFeedForward, StribeckFriction
from estune.reel.velocity import Windows
from estune.support.file_limits import parse_json
from estune.support.toml_file import TomlTable, validate

INTERVALS_MAX = 200
"""Longest window: 0.3 s at 632 Hz, and 10 kB of a board's memory."""

WAVES_MAX = 16
"""Most waves of a map: a sine each in every sample, and 0.5 kB of JSON in a trial's request."""

MEMORY_COUNTS = 0.1
"""Presliding distance where none is given, in encoder counts: far below what can be seen."""


class VelocityTable(TomlTable):
    """Velocity by adaptive windows; see `estune.reel.velocity.Windows`.

    The angle's error is so many counts of the encoder, peak to peak.
    """

    error_counts: Positive = 1.0
    velocity_intervals: Annotated[int, Field(ge=1, le=INTERVALS_MAX)] = 20
    acceleration_intervals: Annotated[int, Field(ge=1, le=INTERVALS_MAX)] = 20
    weak: float = 1.0
    strong: float = 2.0


class FrictionTable(FileOrNumbers):
    """Friction of (10) at the drum: numbers, or a JSON file of them; a share is fed forward.

    It follows the known motion, so that the reel's tension per angle must be given, to within a
    factor of two. Without presliding, the distance is a tenth of an encoder count.
    """

    coulomb_Nm: NotNegative | None = None
    static_Nm: NotNegative | None = None
    stribeck_rad_s: Positive | None = None
    tension_per_rad_N: Positive
    memory_rad: NotNegative = 0.0
    spread: Annotated[float, Field(ge=1.0)] = 1.0
    load_share: NotNegative = 0.0
    fraction: Annotated[float, Field(ge=0.0, le=FRACTION_MAX)] = 0.8

    @property
    def friction(self) -> StribeckFriction:
        """The friction.

        Raises:
            InvalidInput: the file cannot be read, or a number is out of its range.
        """
        if self.file is None:
            return StribeckFriction(self.coulomb_Nm, self.static_Nm, self.stribeck_rad_s)  # type: ignore[arg-type]
        try:
            stored = parse_json(self.file.read_text(encoding="utf-8"))
            return StribeckFriction(**{name: float(value) for name, value in stored.items()})
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise InvalidInput(f"friction {self.file}: {error}") from error


class EyeletTable(TomlTable):
    """Friction where the cable passes the eyelet, along the known motion; a share is taken off.

    `attenuation` is the tension outside over that inside while winding in.
    """

    attenuation: Annotated[float, Field(gt=0.0, lt=1.0)]
    memory_rad: Positive
    tension_per_rad_N: Positive
    fraction: Annotated[float, Field(ge=0.0, le=FRACTION_MAX)] = 0.8

    @property
    def eyelet(self) -> EyeletFeedForward:
        """The share of it."""
        return EyeletFeedForward(-self.fraction * math.log(self.attenuation), self.memory_rad)


class CurrentLimitTable(TomlTable):
    """Current that the drive really gives, where it is less than `limits.current_max_A`."""

    limit_A: Positive


class InertiaTable(TomlTable):
    """Inertia of all rotating parts at the drum, or the part of it that is to be fed forward."""

    inertia_kgm2: Positive


class KnownMotionTable(TomlTable):
    """Inertia and viscous friction at the drum, fed forward along the far end's commanded motion.

    The source of setpoints announces the far end's velocity; nothing is fed back.
    """

    inertia_kgm2: Positive
    viscous_Nms_rad: NotNegative = 0.0


class GravityTable(TomlTable):
    """Weight of the deployed cable; beyond the range of lengths that of its nearest end."""

    weight_N_m: Positive
    rise_m: float
    length_min_m: Positive
    length_max_m: Positive


class AngleMapTable(TomlTable):
    """Torque over the drum's angle, `sum (A_k + c_k R r) sin(N_k theta + phi_k)`, r the setpoint.

    The angle counts from `zero_rad` of the encoder, which must read the same at the same place of
    the drum after every start: an absolute one, or one that the drive sets at its index.
    """

    zero: Literal["absolute", "index"]
    orders: Annotated[list[Positive], Field(min_length=1, max_length=WAVES_MAX)]
    torque_Nm: list[float] = Field(default_factory=list)
    load_share: list[float] = Field(default_factory=list)
    phase_rad: list[float]
    zero_rad: float = 0.0
    lead_s: NotNegative = 0.0
    fraction: Annotated[float, Field(ge=0.0, le=FRACTION_MAX)] = 0.8

    @model_validator(mode="after")
    def _alike(self) -> Self:
        for name in ("torque_Nm", "load_share", "phase_rad"):
            given = len(getattr(self, name))
            if given != len(self.orders) and (given or name == "phase_rad"):
                raise ValueError(
                    f"{name} has {given} numbers and orders has {len(self.orders)}; "
                    "give one for each order"
                )
        if not self.torque_Nm and not self.load_share:
            raise ValueError("give torque_Nm, load_share or both")
        return self

    def map(self, drum_radius_m: float) -> AngleMap:
        """The map, a share of it."""
        none = [0.0] * len(self.orders)
        columns = self.orders, self.torque_Nm or none, self.load_share or none, self.phase_rad
        rows = zip(*columns, strict=True)
        share = self.fraction
        waves = tuple(Wave(n, share * a / drum_radius_m, share * c, phi) for n, a, c, phi in rows)
        return AngleMap(waves, self.zero_rad, self.lead_s)


class NotchTable(TomlTable):
    """A notch in the measurement; a depth of zero takes its frequency away altogether."""

    frequency_Hz: Positive
    width_Hz: Positive = 3.0
    depth: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0


def table_of(text: str, source: str) -> "CompensationTable | None":
    """The table in JSON text; None for one that switches nothing on.

    Raises:
        InvalidInput: it is no JSON, or has mistakes; the message has a line for each.
    """
    try:
        values = parse_json(text)
    except ValueError as error:
        raise InvalidInput(f"{source}: no JSON: {error}") from error
    if not isinstance(values, dict):
        raise InvalidInput(f"{source}: give the keys of [compensation], not {text}")
    table = validate(CompensationTable, values, source) if values else None
    if table is not None and table.friction is not None and table.friction.file is not None:
        raise InvalidInput(f"{source}: friction.file is read in a rig's own file alone")
    return table


COMPENSATIONS = (
    *("friction", "inertia", "known_motion", "gravity", "angle_map", "hum", "mode"),
    *("eyelet", "current_limit"),
)
"""Tables of `[compensation]` that switch something on."""


class CompensationTable(TomlTable):
    """Compensations that run beside the controller; each is on if its table is there.

    All that is fed forward together never exceeds a share of the greatest current.
    """

    share_max: Annotated[float, Field(gt=0.0, le=0.5)] = 0.2
    velocity: VelocityTable = VelocityTable()
    friction: FrictionTable | None = None
    inertia: InertiaTable | None = None
    known_motion: KnownMotionTable | None = None
    gravity: GravityTable | None = None
    angle_map: AngleMapTable | None = None
    hum: NotchTable | None = None
    mode: NotchTable | None = None
    eyelet: EyeletTable | None = None
    current_limit: CurrentLimitTable | None = None

    @model_validator(mode="after")
    def _one_stiffness(self) -> Self:
        if len(self._tensions_per_rad) > 1:
            raise ValueError("friction and eyelet differ in tension_per_rad_N; give the same one")
        return self

    @property
    def _tensions_per_rad(self) -> set[float]:
        along = self.friction, self.eyelet
        return {table.tension_per_rad_N for table in along if table is not None}

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns that a record has of the compensations."""
        columns = {
            "drum_velocity_rad_s": (
                self.friction or self.inertia or self.known_motion or self.angle_map
            ),
            "gravity_N": self.gravity,
            "friction_A": self.friction,
            "inertia_A": self.inertia or self.known_motion,
            "angle_map_A": self.angle_map,
            "notch_N": self.hum or self.mode,
            "eyelet_N": self.eyelet,
            "current_limit_A": self.current_limit,
        }
        return tuple(name for name, table in columns.items() if table is not None)

    @property
    def text(self) -> str:
        """The keys that were given as JSON, as a trial's request has them, friction as numbers.

        Raises:
            InvalidInput: the friction's file cannot be read.
        """
        values = self.model_dump(exclude_unset=True)
        if self.friction is not None and self.friction.file is not None:
            del values["friction"]["file"]
            values["friction"] |= asdict(self.friction.friction)
        return json.dumps(values, sort_keys=True)

    def without(self, names: Sequence[str]) -> "CompensationTable | None":
        """This table without some of the compensations; None where nothing is left on.

        Raises:
            InvalidInput: one of them is not on.
        """
        for name in names:
            if name not in COMPENSATIONS or getattr(self, name) is None:
                raise InvalidInput(f"[compensation.{name}] is not on: it cannot be switched off")
        kept = self.model_fields_set - set(names)
        left = type(self)(**{name: getattr(self, name) for name in kept})
        return left if left.columns else None

    def plan(
        self,
        sampling_Hz: float,
        encoder_counts: float,
        drum_radius_m: float,
        cable_length_m: float | None,
        effort_max_N: float,
        *,
        newtons_per_ampere: float,
    ) -> CompensationPlan:
        """The compensations of a reel.

        Args:
            encoder_counts: Encoder counts per turn, of any sign.
            cable_length_m: Length at an angle of zero, m; None where it is not known.
            newtons_per_ampere: Effort per motor current, N/A.

        Raises:
            InvalidInput: a table is not complete, or a number is out of its range.
        """
        if not self.columns:
            raise InvalidInput(
                f"[compensation] switches nothing on; add one of its tables, "
                f"{', '.join(COMPENSATIONS)}, or leave it out"
            )
        limit, count_rad = self.share_max * effort_max_N, 2.0 * math.pi / abs(encoder_counts)
        settings = self.velocity.model_dump(exclude={"error_counts"})
        windows = Windows(self.velocity.error_counts * count_rad, **settings)
        return CompensationPlan(
            period_s=1.0 / sampling_Hz,
            windows=windows,
            friction=self._friction(count_rad, drum_radius_m, limit),
            tension_per_rad_N=next(iter(self._tensions_per_rad), 1.0),
            inertia_kgm2=self.inertia.inertia_kgm2 if self.inertia else 0.0,
            known_inertia_kgm2=self.known_motion.inertia_kgm2 if self.known_motion else 0.0,
            known_viscous_Nms_rad=self.known_motion.viscous_Nms_rad if self.known_motion else 0.0,
            gravity=self._gravity(cable_length_m, limit),
            angle_map=self._angle_map(drum_radius_m, limit),
            notches=self._notches(sampling_Hz),
            eyelet=self.eyelet.eyelet if self.eyelet else None,
            effort_limit_N=self._effort_limit_N(effort_max_N, newtons_per_ampere),
            drum_radius_m=drum_radius_m,
            feed_forward_max_N=limit,
            columns=self.columns,
        )

    def _friction(
        self, count_rad: float, drum_radius_m: float, limit_N: float
    ) -> FrictionFeedForward | None:
        table = self.friction
        if table is None:
            return None
        memory = table.memory_rad or MEMORY_COUNTS * count_rad
        shares = table.load_share, table.fraction, table.spread
        forward = FrictionFeedForward(table.friction, memory, *shares)
        largest_N = forward.fraction * forward.friction.static_Nm / drum_radius_m
        self._check_share("friction", largest_N, limit_N, "static_Nm")
        return forward

    def _angle_map(self, drum_radius_m: float, limit_N: float) -> AngleMap | None:
        if self.angle_map is None:
            return None
        found = self.angle_map.map(drum_radius_m)
        largest_N = sum(abs(wave.force_N) for wave in found.waves)
        self._check_share("angle_map", largest_N, limit_N, "torque_Nm")
        return found

    def _check_share(self, name: str, largest_N: float, limit_N: float, number: str) -> None:
        if largest_N > limit_N:
            raise InvalidInput(
                f"compensation.{name} takes up to {largest_N:.4g} N, above compensation.share_max "
                f"{self.share_max:g} of the greatest effort, {limit_N:.4g} N; check the unit of "
                f"{number}, then raise share_max"
            )

    def _notches(self, sampling_Hz: float) -> tuple[Notch, ...]:
        found = []
        for name in ("hum", "mode"):
            table: NotchTable | None = getattr(self, name)
            if table is None:
                continue
            upper = table.frequency_Hz + 0.5 * table.width_Hz
            if not (upper < 0.5 * sampling_Hz and table.width_Hz < table.frequency_Hz):
                raise InvalidInput(
                    f"compensation.{name}: a notch at {table.frequency_Hz:g} Hz, "
                    f"{table.width_Hz:g} Hz wide, does not lie between 0 and half the sampling "
                    f"rate, {0.5 * sampling_Hz:g} Hz"
                )
            found.append(Notch.at(table.frequency_Hz, table.width_Hz, table.depth, sampling_Hz))
        return tuple(found)

    def _effort_limit_N(self, effort_max_N: float, newtons_per_ampere: float) -> float:
        if self.current_limit is None:
            return 0.0
        limit_A, max_A = self.current_limit.limit_A, effort_max_N / newtons_per_ampere
        if not limit_A < max_A:
            raise InvalidInput(
                f"compensation.current_limit.limit_A {limit_A:g} A is not below the rig's own "
                f"greatest current, {max_A:.4g} A: leave it out"
            )
        return limit_A * newtons_per_ampere

    def _gravity(self, cable_length_m: float | None, limit_N: float) -> Gravity | None:
        table = self.gravity
        if table is None:
            return None
        if cable_length_m is None:
            raise InvalidInput(
                "compensation.gravity needs reel.cable_length_m, the length at an encoder count "
                "of 0"
            )
        if not table.length_min_m <= cable_length_m <= table.length_max_m:
            raise InvalidInput(
                f"reel.cable_length_m {cable_length_m:g} m is outside compensation.gravity "
                f"{table.length_min_m:g} to {table.length_max_m:g} m"
            )
        if not abs(table.rise_m) <= table.length_min_m:
            raise InvalidInput(
                f"compensation.gravity.rise_m {table.rise_m:g} m exceeds the least length, "
                f"{table.length_min_m:g} m: the cable would not reach"
            )
        self._check_share("gravity", table.weight_N_m * table.length_max_m, limit_N, "weight_N_m")
        numbers = table.weight_N_m, table.rise_m, cable_length_m
        return Gravity(*numbers, table.length_min_m, table.length_max_m)
