"""Units of recorded data, with the conversions that a drum makes possible."""

import math
import re
from typing import NamedTuple

from estune.errors import InvalidInput


class Unit(NamedTuple):
    """A unit as a multiple of the SI unit of its dimension."""

    dimension: str
    factor: float


UNITS = {
    "s": Unit("time", 1.0),
    "ms": Unit("time", 1e-3),
    "us": Unit("time", 1e-6),
    "ns": Unit("time", 1e-9),
    "min": Unit("time", 60.0),
    "h": Unit("time", 3600.0),
    "N": Unit("force", 1.0),
    "mN": Unit("force", 1e-3),
    "kN": Unit("force", 1e3),
    "kgf": Unit("force", 9.80665),
    "gf": Unit("force", 9.80665e-3),
    "lbf": Unit("force", 4.4482216152605),
    "A": Unit("current", 1.0),
    "mA": Unit("current", 1e-3),
    "kA": Unit("current", 1e3),
    "rad": Unit("angle", 1.0),
    "mrad": Unit("angle", 1e-3),
    "deg": Unit("angle", math.pi / 180.0),
    "turn": Unit("angle", 2.0 * math.pi),
    "m": Unit("length", 1.0),
    "cm": Unit("length", 1e-2),
    "mm": Unit("length", 1e-3),
    "um": Unit("length", 1e-6),
    "in": Unit("length", 0.0254),
    "Nm": Unit("torque", 1.0),
    "mNm": Unit("torque", 1e-3),
    "kHz": Unit("frequency", 1e3),
}
_SPELLINGS = {
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "µs": "us",
    "μs": "us",
    "minutes": "min",
    "Newton": "N",
    "newton": "N",
    "newtons": "N",
    "lb": "lbf",
    "kp": "kgf",
    "Amp": "A",
    "amp": "A",
    "amps": "A",
    "ampere": "A",
    "Ampere": "A",
    "degree": "deg",
    "degrees": "deg",
    "°": "deg",
    "radian": "rad",
    "radians": "rad",
    "turns": "turn",
    "rev": "turn",
    "revs": "turn",
    "µm": "um",
    "μm": "um",
    "inch": "in",
}
_PRODUCT = re.compile(r"[ .*·⋅]")


def find_unit(text: str) -> str | None:
    """The name in `UNITS` of a unit as a file or a user writes it; None where it is not known."""
    bare = text.strip().strip("[]()").strip()
    name = _SPELLINGS.get(bare, bare)
    if name not in UNITS:
        name = _PRODUCT.sub("", name)  # mN m, mN.m, mN*m
    return name if name in UNITS else None


class Drum(NamedTuple):
    """Numbers of a reel's model that turn lengths into angles and torques into currents.

    Attributes:
        radius_m: Radius at which the cable lies, or None.
        newtons_per_ampere: Torque constant over radius, or None.
    """

    radius_m: float | None = None
    newtons_per_ampere: float | None = None

    def factor(self, of: str, to: str) -> float:
        """SI units of dimension `to` per SI unit of dimension `of`.

        Raises:
            InvalidInput: there is no such conversion, or the number it takes is not known.
        """
        R, N_A = self.radius_m, self.newtons_per_ampere
        through: dict[tuple[str, str], tuple[str, float | None]] = {
            ("length", "angle"): ("drum radius", R and 1.0 / R),
            ("torque", "force"): ("drum radius", R and 1.0 / R),
            ("force", "current"): ("force per ampere", N_A and 1.0 / N_A),
            ("current", "force"): ("force per ampere", N_A),
            ("torque", "current"): ("radius and force per ampere", R and N_A and 1.0 / (R * N_A)),
        }
        if of == to:
            return 1.0
        if (of, to) not in through:
            raise InvalidInput(f"{of} is not {to}; correct the unit or the column")
        what, factor = through[of, to]
        if factor is None:
            raise InvalidInput(
                f"{of} becomes {to} by a reel's {what}, which is not known here; give a model "
                "that has it, or a scale instead of the unit"
            )
        return factor


NO_DRUM = Drum()


def si_factor(unit: str, wanted: str, drum: Drum) -> float:
    """Factor from a unit of `UNITS` to an SI unit, through the drum where the dimensions differ.

    Raises:
        InvalidInput: as of `Drum.factor`.
    """
    own = UNITS[unit]
    return own.factor * drum.factor(own.dimension, UNITS[wanted].dimension)
