"""Machines with something hidden in them, that hand over nothing but records.

Nothing here knows the code under test, nor is known to it: other coordinates (forces at the rim
and metres of cable), another integrator, other laws for the same effects, other noise.
"""

from tests.hidden.cases import VARIANTS, Case, Secret, draw, family
from tests.hidden.effects import CATALOGUE, OUTSIDE
from tests.hidden.machine import NoCompiler
from tests.hidden.records import Record, write

__all__ = [
    "CATALOGUE",
    "OUTSIDE",
    "VARIANTS",
    "Case",
    "NoCompiler",
    "Record",
    "Secret",
    "draw",
    "family",
    "write",
]
