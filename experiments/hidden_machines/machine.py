"""The hidden machine: `machine.c` and `equations.h`, compiled and called.

Compiled with the C compiler of the system into the temporary folder, once per text. It shares
nothing with the code under test, its compiler wrapper included.
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]

SUBSTEP_s = 1e-4
WARM_UP_s = 1.2

FLAGS = ("-O2", "-std=gnu11", "-shared", "-fPIC", "-fvisibility=hidden")
COMPILERS = ("cc", "gcc", "clang")

OFF = {
    "gain": 1.0,
    "lag": 1e-4,
    "hold": 1.0,
    "inner": 0.3,
    "dry_velocity": 1.0,
    "bristle": 1e-5,
    "bristle_damping": 0.7,
    "slew_soft": 4e-4,
    "D_filter": 2e-3,
    "filter": 1e-9,
}
"""Default values other than zero."""


class NoCompiler(RuntimeError):
    """There is no C compiler; the machine cannot be run."""


class DriveSignals(NamedTuple):
    """Signals of a record; columns of one value per sample, without the warm-up.

    Attributes:
        setpoint: Force command, or what the controller follows.
        added: What is added to the gauge's signal before the converter.
        disturbance: Force on the drum that nobody records.
        scale: Factor of the gauge's signal, or None.
        late: Share of a sample by which each sample is taken late, or None.
    """

    setpoint: Column
    added: Column
    disturbance: Column
    scale: Column | None = None
    late: Column | None = None


class Run(NamedTuple):
    """The signals, and the motor's temperature at the end."""

    tension: Column
    angle: Column
    command: Column
    force: Column
    outside: Column
    warmth: float


@cache
def compiled(source: Path) -> ctypes.CDLL:
    """A C text, with the headers beside it, as a library.

    Raises:
        NoCompiler: there is no C compiler.
    """
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise NoCompiler("the hidden machine needs a C compiler: cc, gcc or clang")
    texts = [file.read_bytes() for file in (source, *sorted(source.parent.glob("*.h")))]
    key = hashlib.sha256(b"".join(texts) + repr((compiler, FLAGS)).encode()).hexdigest()[:24]
    product = Path(tempfile.gettempdir()) / f"hidden-{source.stem}-{os.getuid()}-{key}.so"
    if not product.exists():
        with tempfile.TemporaryDirectory(prefix="hidden-") as workshop:
            made = Path(workshop, "machine.so")
            subprocess.run([compiler, *FLAGS, "-o", made, source, "-lm"], check=True)
            shutil.copy(made, product.with_suffix(f".{os.getpid()}"))
        product.with_suffix(f".{os.getpid()}").replace(product)
    return ctypes.CDLL(str(product))


@cache
def library() -> ctypes.CDLL:
    """The compiled machine.

    Raises:
        NoCompiler: there is no C compiler.
    """
    loaded = compiled(Path(__file__).with_name("machine.c"))
    loaded.machine_parameters.restype = ctypes.c_char_p
    loaded.machine_numbers.restype = ctypes.c_long
    loaded.machine_warmth.restype = ctypes.c_double
    return loaded


@cache
def names() -> tuple[str, ...]:
    """The parameters of a machine, in the order of the C text."""
    return tuple(library().machine_parameters().decode().split())


def run(
    machine: dict[str, float],
    drive: DriveSignals,
    sampling_Hz: float,
    *,
    rest_N: float = 0.0,
    warmth: float = 0.0,
) -> Run:
    """One record, after a warm-up at the first setpoint.

    Args:
        machine: Parameters in force at the rim, metres and seconds; see `equations.h` and `OFF`.
        drive: What goes in.
        sampling_Hz: Sampling rate.
        rest_N: Tension near which the warm-up starts.
        warmth: Of the motor at the start.

    Raises:
        ArithmeticError: the motion did not stay finite.
    """
    known = names()
    if unknown := set(machine) - set(known):
        raise KeyError(f"a machine has no {sorted(unknown)}")
    p = np.array([machine.get(name, OFF.get(name, 0.0)) for name in known])
    dt = 1.0 / sampling_Hz
    warm_up = round(WARM_UP_s * sampling_Hz)
    samples = warm_up + drive.setpoint.size

    def lengthened(column: Column | None, otherwise: float) -> Column:
        if column is None:
            return np.full(samples, otherwise)
        return np.concatenate([np.full(warm_up, column[0]), column])

    columns = (
        lengthened(drive.setpoint, 0.0),
        lengthened(drive.added, 0.0),
        lengthened(drive.scale, 1.0),
        lengthened(drive.disturbance, 0.0),
        lengthened(drive.late, 0.0),
    )
    out = np.zeros((5, samples))
    numbers = np.zeros(library().machine_numbers())
    gain = machine.get("gain", 1.0)
    command = (rest_N - machine.get("push", 0.0)) / gain if machine.get("control") else 0.0
    if not machine.get("control"):
        command = float(drive.setpoint[0])
    double = ctypes.c_double
    library().machine_rest(
        _at(p), double(rest_N), double(drive.setpoint[0]), double(command), _at(numbers)
    )
    library().machine_warm(_at(numbers), double(warmth))
    failed = library().machine_run(
        _at(p),
        ctypes.c_long(samples),
        double(dt),
        ctypes.c_long(int(np.ceil(dt / SUBSTEP_s))),
        *map(_at, columns),
        _at(numbers),
        *map(_at, out),
    )
    if failed:
        raise ArithmeticError("the hidden machine's motion did not stay finite")
    tension, angle, ordered, reached, outside = (row[warm_up:].copy() for row in out)
    warm = float(library().machine_warmth(_at(numbers)))
    return Run(tension, angle, ordered, reached, outside, warm)


def _at(array: Column) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
