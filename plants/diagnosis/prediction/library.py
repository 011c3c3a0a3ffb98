"""Compiled library that predicts records with one model structure."""

import ctypes
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca

from estune.errors import PlantError
from plants.diagnosis.models.diagnosed_model import SENSORS
from plants.models.path_structure import PathStructure
from plants.models.symbolic_plant import TracedStructure
from plants.simulation.c_source import c_source
from plants.simulation.compiled_structure import compiled
from plants.simulation.equations import Equations

CHANNELS = ("tension_N", "angle_rad", "reference_N", "current_A")
"""Predicted channels, in the order of the C code."""

OPTIMISE = "-O1"
"""A diagnosis compiles some 40 structures. One takes 0.19 s of CPU, and 0.33 s at -O3, by which a
diagnosis of 8 records of 10 000 samples takes 9.4 s, and 10.2 s by this, compilers not counted."""


class Task(ctypes.Structure):
    """Argument of `estune_predict`; see `prediction.c`."""

    _fields_ = (
        *((name, ctypes.c_long) for name in ("rows", "records", "samples", "entries", "kept")),
        *(
            (name, ctypes.c_void_p)
            for name in (
                *("record_samples", "preload", "reading", "command"),
                *("windows", "window_at", "window_place", "table", "kick"),
                *("measured", "weight", "source", "block_end", "record_blocks", "wanted"),
                *("basis", "outputs", "chosen", "residuals"),
            )
        ),
    )


class Library:
    """The compiled loop of one structure. Calls release the interpreter's lock.

    Attributes:
        columns: Column of each parameter and sensor in the table.
        placed: Number of states that are reset.
    """

    def __init__(self, structure: PathStructure | TracedStructure) -> None:
        """Compiles the structure, unless it is cached.

        Raises:
            PlantError: no compiler, or it failed.
        """
        names = (*structure.parameter_names, *SENSORS)
        self.columns = {name: n for n, name in enumerate(names)}
        try:
            library = compiled(
                structure,
                "prediction",
                lambda: _source(structure.equations(), self.columns["delay_samples"]),
                OPTIMISE,
            )
        except PlantError as error:
            raise PlantError(
                f"predictions have to be compiled, and cannot be: {error}; install gcc or clang"
            ) from error
        self.placed = ctypes.c_int.in_dll(library, "estune_placed").value
        self._predict = library.estune_predict
        self._predict.argtypes = (ctypes.c_void_p,)
        self._predict.restype = ctypes.c_int

    def run(self, task: Task) -> None:
        """Fills the task's outputs, its residuals, or both.

        Raises:
            MemoryError: there is not enough memory.
        """
        if self._predict(ctypes.byref(task)):
            raise MemoryError("no memory for a prediction; predict fewer rows at once")


@lru_cache(maxsize=256)
def library(structure: PathStructure | TracedStructure) -> Library:
    """The library of a structure, made once per process."""
    return Library(structure)


def _source(plant: Equations, delay: int) -> str:
    functions = _functions(plant)
    late, prepare, settle, _, place, *_ = functions
    sizes = {
        "CONSTANTS": prepare.numel_out(0),
        "STATES": settle.numel_out(0),
        "SUBSTEPS": plant.substeps,
        "PARAMETERS": late.numel_in(0),
        "PLACED": place.numel_in(2),
        "DELAY": delay,
    }
    loop = Path(__file__).with_name("prediction.c")
    return c_source(functions, sizes, loop, ("locate", "place", "sense", "substep"))


def _functions(plant: Equations) -> tuple[Any, ...]:
    """Functions the loop calls; outputs dense, for generated C writes structural nonzeros only."""
    parameters, preload = plant.prepare.sx_in()
    constants, _, _ = plant.prepare(parameters, preload)
    c, reading = plant.settle.sx_in()
    rest, rest_effort = plant.settle(c, reading)
    _, rest_drive = plant.drive(c, rest, rest_effort)
    x, placed = plant.place.sx_in()[1:]
    before, effort = ca.SX.sym("before"), ca.SX.sym("effort")
    observed, measurement, angle = plant.observe(c, x, before, 0.0)
    outside = measurement if plant.outside is None else plant.outside(c, observed)
    driven, drive = plant.drive(c, observed, effort)
    *held, n = plant.substep.sx_in()
    written = {
        "late": ([parameters], [plant.dead_time_samples(parameters)]),
        "prepare": ([parameters, preload], [constants]),
        "settle": ([c, reading], [rest, rest_drive]),
        "locate": ([c, x], [plant.locate(c, x)]),
        "place": ([c, x, placed], [plant.place(c, x, placed)]),
        "drive": ([c, x, effort], plant.drive(c, x, effort)),
        "sense": ([c, x, before, effort], [driven, measurement, angle, outside, drive]),
        "substep": ([*held, n], [plant.substep(*held, n)]),
    }
    return tuple(
        ca.Function(f"estune_{name}", inputs, [ca.densify(ca.SX(output)) for output in outputs])
        for name, (inputs, outputs) in written.items()
    )
