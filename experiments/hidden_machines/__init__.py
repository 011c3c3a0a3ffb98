"""Machines with something hidden in them, that hand over nothing but records.

Nothing here knows the code under test, nor is known to it: other coordinates (forces at the rim
and metres of cable), another integrator, other laws for the same effects, other noise.
"""

from experiments.hidden_machines.batteries import RecordPlan
from experiments.hidden_machines.cases import (
    VARIANTS,
    Case,
    Secret,
    draw,
    family,
    further_record,
)
from experiments.hidden_machines.effects import CATALOGUE
from experiments.hidden_machines.machine import NoCompiler
from experiments.hidden_machines.records import MachineRecord, write
from experiments.hidden_machines.undeclared_effects import OUTSIDE

__all__ = [
    "CATALOGUE",
    "OUTSIDE",
    "VARIANTS",
    "Case",
    "MachineRecord",
    "NoCompiler",
    "RecordPlan",
    "Secret",
    "draw",
    "family",
    "further_record",
    "write",
]
