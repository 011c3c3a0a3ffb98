"""Amounts in words: numbers with units, with torques and angles of a reel also at the cable.

Amounts of a plant that is no reel are in its own units.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

_PREFIXES = {-6: "µ", -3: "m", 0: "", 3: "k"}
_SCALED = {"N", "m", "s", "A", "N m", "rad"}
"""Units that are written with a prefix; N m/A or kg/m are not."""

CHANNEL_TITLES = {
    "tension_N": "tension",
    "angle_rad": "angle",
    "reference_N": "tension outside",
    "current_A": "current",
}

ENDINGS = {
    "N m": "_Nm",
    "rad": "_rad",
    "rad/s": "_rad_s",
    "N m s/rad": "_Nms",
    "N m s2/rad2": "_Nms2",
}
"""What names of parameters end in, by their unit, of those that a plant may measure otherwise."""

_INPUT, _OUTPUT = "in the input's unit", "in the output's unit"
"""Units of a plant that states none."""


def si(value: float, unit: str) -> str:
    """A value to three digits with its unit, in millimetres and the like where that is shorter."""
    size = abs(value)
    if unit not in _SCALED or not math.isfinite(value) or size == 0.0 or 0.1 <= size < 1e3:
        return f"{digits(value)} {unit}".rstrip()
    power = min(max(3 * math.floor(math.log10(size * 1.0005) / 3.0), -6), 3)
    if unit in {"N", "N m"} and power < 0 and size >= 0.01:
        power = 0  # 0.02 N reads better than 20 mN beside other tensions
    return f"{digits(value / 10.0**power)} {_PREFIXES[power]}{unit}"


def digits(value: float) -> str:
    """A number to three digits, without an exponent up to a million."""
    text = f"{value:.3g}"
    return f"{float(text):.0f}" if "e+0" in text and abs(value) < 1e6 else text


def share(value: float) -> str:
    """A share in per cent."""
    return f"{digits(100.0 * value)} %"


def written_unit(unit: str, model: Any) -> str:
    """The unit of an output as written; of a plant the one it states, if any."""
    scale = PlantScale.of(model)
    return scale.output_unit if scale.is_plant else scale.unit(unit)


class PlantScale(NamedTuple):
    """Words and sizes of a plant that the sentences of effects refer to.

    Attributes:
        subject: What the model is of: a reel, a drive, a stage, or any plant.
        radius_m: Drum radius, m; nan without a drum.
        length_m: Cable length, m; nan without a cable.
        tension_N: Usual tension, N; nan where there is none.
        stiffness_N_m: Of the cable, N/m; nan without one.
        newtons_per_ampere: Effort per motor current, N/A.
        sampling_Hz: Rate of the controller; nan if not known.
        dead_time_s: From a command to its torque, s.
        units: The plant's own units by those of a drum, where they differ.
        names: The plant's own names of numbers and columns by those of a drum.
        input_unit: Unit of the input of a plant known by input and output; empty if not stated.
        channels: Title and unit of columns that the plant names and measures otherwise.
    """

    subject: str = "plant"
    radius_m: float = math.nan
    length_m: float = math.nan
    tension_N: float = math.nan
    stiffness_N_m: float = math.nan
    newtons_per_ampere: float = math.nan
    sampling_Hz: float = math.nan
    dead_time_s: float = 0.0
    units: Mapping[str, str] = {}
    names: Mapping[str, str] = {}
    input_unit: str = ""
    output_unit: str = ""
    channels: Mapping[str, tuple[str, str]] = {}

    @classmethod
    def of(cls, model: Any) -> "PlantScale":
        """The words and sizes that a model declares; those of any plant for one that does not."""
        scale = getattr(model, "scale", None)
        return scale if isinstance(scale, cls) else cls()

    def unit(self, unit: str) -> str:
        """A drum's unit in the plant's own."""
        return self.units.get(unit, unit)

    def name(self, name: str) -> str:
        """A drum's number or column by the plant's own name."""
        return self.names.get(name, name)

    def channel(self, column: str) -> tuple[str, str]:
        """Title and unit of a column; an angle in metres is a position."""
        if column in self.channels:
            return self.channels[column]
        unit = self.unit(column.rpartition("_")[2])
        return "position" if unit == "m" else CHANNEL_TITLES[column], unit

    def amount(self, value: float, unit: str) -> str:
        """A value in a drum's unit, written in the plant's own."""
        return si(value, self.unit(unit))

    @property
    def is_plant(self) -> bool:
        """Whether it is known by input and output alone, in units of its own."""
        return self.subject == "plant"

    @property
    def usual_tension_N(self) -> float:
        """Tension that sentences refer to."""
        return self.tension_N if math.isfinite(self.tension_N) else 10.0

    @property
    def has_cable(self) -> bool:
        """Whether there is a cable on the drum."""
        return math.isfinite(self.length_m)

    @property
    def at_drum(self) -> str:
        """Place of the friction, in words."""
        return " at the drum" if self.subject == "reel" else ""

    def parameter(self, name: str, unit: str, own: str = "") -> str:
        """Name of an effect's parameter of a unit, which it ends in, with the plant's own.

        Args:
            name: Its name as declared.
            unit: Its unit as declared.
            own: Its unit of this plant; by default that of a drum's in the plant's own.
        """
        own, ending = own or self.unit(unit), ENDINGS.get(unit, "")
        if own == unit or not ending or not name.endswith(ending):
            return name
        stem = name.removesuffix(ending)
        if self.is_plant or own == "N":
            stem = stem.replace("torque", "effort" if self.is_plant else "force")
        return f"{stem}_{own.replace('/', '_').replace(' ', '')}"

    def torque(self, torque_Nm: float) -> str:
        """A torque, and the tension it is at the cable."""
        if self.is_plant:
            return self.of_input(torque_Nm)
        at_cable = torque_Nm / self.radius_m if self.has_cable else math.nan
        return f"{self.amount(torque_Nm, 'N m')}{also(at_cable, 'N', ' at the cable')}"

    def damping(self, damping_Nms: float) -> str:
        """A viscous friction at the drum, and at the cable."""
        if self.is_plant:
            return f"{self.of_input(damping_Nms)} for each unit of the output per second"
        at_cable = damping_Nms / self.radius_m**2 if self.has_cable else math.nan
        return f"{self.amount(damping_Nms, 'N m s/rad')}{also(at_cable, 'N per m/s', ' of cable')}"

    def travel(self, angle_rad: float) -> str:
        """An angle of the drum, and the cable it winds."""
        if self.is_plant:
            return self.of_output(angle_rad)
        wound = angle_rad * self.radius_m if self.has_cable else math.nan
        return f"{self.amount(angle_rad, 'rad')}{also(wound, 'm', ' of cable')}"

    def periods(self, number: float) -> str:
        """How often a wave comes back: in a turn, or of a position every so many metres."""
        unit = self.output_unit or _OUTPUT if self.is_plant else self.unit("rad")
        return (
            f"{digits(number)} times a turn"
            if unit == "rad"
            else f"every {si(1.0 / number, unit)}"
        )

    @property
    def along(self) -> str:
        """What a wave is over, in words."""
        return "angle" if self.unit("rad") == "rad" and not self.is_plant else "position"

    def cable(self, length_m: float) -> str:
        """A length of cable."""
        if self.is_plant:
            return self.of_output(length_m)
        return si(length_m, "m")

    def speed(self, velocity_rad_s: float) -> str:
        """A velocity of the drum, and of the cable."""
        if self.is_plant:
            return f"{self.of_output(velocity_rad_s)} per second"
        wound = velocity_rad_s * self.radius_m if self.has_cable else math.nan
        return f"{self.amount(velocity_rad_s, 'rad/s')}{also(wound, 'm/s', ' of cable')}"

    def current(self, current_A: float, per: str = "") -> str:
        """A current, and the tension it holds."""
        if self.is_plant:
            return f"{self.of_input(current_A)}{' per second' if per else ''}"
        force = current_A * self.newtons_per_ampere if self.unit("A") == "A" else math.nan
        return f"{self.amount(current_A, f'A{per}')}{also(force, f'N{per}')}"

    def reading(self, tension_N: float) -> str:
        """A tension, or what stands for it in a plant's output."""
        if self.is_plant:
            return self.of_output(tension_N)
        return si(tension_N, "N")

    def of_input(self, value: float) -> str:
        """A value of a plant's input."""
        return f"{digits(value)} {self.input_unit or _INPUT}"

    def of_output(self, value: float) -> str:
        """A value of a plant's output."""
        return f"{digits(value)} {self.output_unit or _OUTPUT}"


def also(value: float, unit: str, of: str = "") -> str:
    """The value in another unit, in brackets; nothing where that is not finite."""
    return f" ({si(value, unit)}{of})" if math.isfinite(value) else ""
