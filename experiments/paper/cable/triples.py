"""Triples of quantities that determine a hanging cable, and their numbers of solutions."""

from itertools import combinations
from typing import Literal

from estune.errors import InvalidInput

NAMES = (
    "length_m",
    "rise_m",
    "span_m",
    "tension_x_N",
    "tension_1z_N",
    "tension_3z_N",
    "tension_1_N",
    "tension_3_N",
)
"""The eight quantities: ds, dz, dx, T_x, T_1z, T_3z, |T_1| and |T_3|."""

Solution = Literal["only", "shorter", "longer", "lower", "higher"]
"""Choice between two solutions: by length, or by the far end's height for a known length."""

Triple = frozenset[str]


def _triple(text: str) -> Triple:
    short = dict(zip(("s", "z", "x", "H", "V1", "V3", "T1", "T3"), NAMES, strict=True))
    return frozenset(short[word] for word in text.split())


DEPENDENT: dict[Triple, str] = {
    _triple("s V1 V3"): "tension_3z_N = tension_1z_N + weight * length_m",
    _triple("z T1 T3"): "tension_3_N = tension_1_N + weight * rise_m",
    _triple("H V1 T1"): "tension_1_N^2 = tension_x_N^2 + tension_1z_N^2",
    _triple("H V3 T3"): "tension_3_N^2 = tension_x_N^2 + tension_3z_N^2",
}
"""The four dependent triples, with their relation."""

_BY_HEIGHT = {_triple(text) for text in ("s H T1", "s H T3", "s x H", "s x T1", "s x T3")}
_BY_LENGTH = {
    _triple(text)
    for text in (
        *("z H V1", "z H V3", "z H T1", "z H T3", "z V1 T1", "z V3 T3", "z V1 T3", "z V3 T1"),
        *("H V1 T3", "H V3 T1", "H T1 T3", "V1 T1 T3", "V3 T1 T3"),
        *("x H T1", "x H T3", "x z V1", "x z V3", "x z T1", "x z T3", "x T1 T3"),
        *("x V1 T3", "x V3 T1"),
    )
}


def _solutions(triple: Triple) -> tuple[Solution, ...]:
    if triple in _BY_HEIGHT:
        return ("lower", "higher")
    return ("shorter", "longer") if triple in _BY_LENGTH else ("only",)


ADMISSIBLE: dict[Triple, tuple[Solution, ...]] = {
    triple: _solutions(triple)
    for triple in map(frozenset, combinations(NAMES, 3))
    if triple not in DEPENDENT
}
"""The 52 triples that determine a cable: `("only",)`, or the names of the two that may fit."""


def check_triple(given: Triple, solution: str) -> tuple[Solution, ...]:
    """Names of a triple's solutions.

    Raises:
        InvalidInput: not three quantities, not independent, or no such solution.
    """
    if len(given) != 3:
        names = ", ".join(name for name in NAMES if name in given) or "none"
        raise InvalidInput(
            f"a hanging cable is determined by three of {', '.join(NAMES)}; given: {names}"
        )
    if given in DEPENDENT:
        names = ", ".join(name for name in NAMES if name in given)
        raise InvalidInput(
            f"{names} are not independent ({DEPENDENT[given]}); replace one of them"
        )
    solutions = ADMISSIBLE[given]
    if solution not in {"only", *solutions}:
        names = ", ".join(name for name in NAMES if name in given)
        choice = " or ".join(f"'{s}'" for s in dict.fromkeys(("only", *solutions)))
        raise InvalidInput(f"solution is '{solution}'; for {names} it is {choice}")
    return solutions
