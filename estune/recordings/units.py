"""Units of recorded data, with the conversions that a drum makes possible."""

import math
import re
import unicodedata
from typing import NamedTuple

from estune.errors import InvalidInput


class Unit(NamedTuple):
    """A unit by its SI unit: SI value = value x factor + offset."""

    dimension: str
    factor: float
    offset: float = 0.0


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
    "kgfcm": Unit("torque", 0.0980665),
    "rad/s": Unit("speed", 1.0),
    "deg/s": Unit("speed", math.pi / 180.0),
    "rpm": Unit("speed", math.pi / 30.0),
    "turn/s": Unit("speed", 2.0 * math.pi),
    "m/s": Unit("velocity", 1.0),
    "mm/s": Unit("velocity", 1e-3),
    "km/h": Unit("velocity", 1.0 / 3.6),
    "V": Unit("voltage", 1.0),
    "mV": Unit("voltage", 1e-3),
    "W": Unit("power", 1.0),
    "kW": Unit("power", 1e3),
    "Pa": Unit("pressure", 1.0),
    "kPa": Unit("pressure", 1e3),
    "mbar": Unit("pressure", 1e2),
    "bar": Unit("pressure", 1e5),
    "K": Unit("temperature", 1.0),
    "degC": Unit("temperature", 1.0, 273.15),
    "degF": Unit("temperature", 5.0 / 9.0, 459.67 * 5.0 / 9.0),
    "%": Unit("share", 1e-2),
    "Hz": Unit("frequency", 1.0),
    "kHz": Unit("frequency", 1e3),
}
_WRITTEN = {
    "s": "sec second seconds",
    "us": "μs usec micros microseconds",
    "ms": "msec millis milliseconds",
    "min": "minutes",
    "h": "hours hrs",
    "N": "Newton newton newtons",
    "lbf": "lb",
    "kgf": "kp",
    "A": "Amp amp amps ampere Ampere",
    "deg": "degree degrees °",
    "rad": "radian radians",
    "turn": "turns rev revs",
    "um": "μm",
    "in": "inch",
    "rpm": "1/min min-1 r/min U/min rev/min",
    "deg/s": "°/s dps",
    "turn/s": "rps rev/s turns/s",
    "V": "volt volts",
    "W": "watt watts",
    "degC": "C °C Celsius",
    "degF": "F °F Fahrenheit",
    "K": "Kelvin",
    "%": "percent pct",
    "kgfcm": "kgcm",
}
"""Other spellings of each unit."""
_SPELLINGS = {word: unit for unit, words in _WRITTEN.items() for word in words.split()}
_BY_LETTERS = {
    name.lower(): unit for name, unit in {**_SPELLINGS, **{u: u for u in UNITS}}.items()
}
"""For words that are written with any capitals, as RPM and Volts; not for the letters of SI."""
_PRODUCT = re.compile(r"[ .*·⋅]")
_WORD_LETTERS = 3
"""Letters from which capitals do not matter: mN and MN differ, RPM and rpm do not."""


def find_unit(text: str) -> str | None:
    """The name in `UNITS` of a unit as a file or a user writes it; None where it is not known."""
    bare = unicodedata.normalize("NFKC", text).strip().strip("[](){}<>").strip()
    for name in (bare, _PRODUCT.sub("", bare)):  # mN m, mN.m, mN*m
        found = _SPELLINGS.get(name, name)
        if found in UNITS:
            return found
    return _BY_LETTERS.get(bare.lower()) if len(bare) >= _WORD_LETTERS else None


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
            ("velocity", "speed"): ("drum radius", R and 1.0 / R),
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
