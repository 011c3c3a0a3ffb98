"""The reference trial in hand-written C, independently of the simulation."""

import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from estune.support import c_compiler
from plants.simulation.trial_loop import Batch


def reference_library() -> ctypes.CDLL:
    """reference_trial.c, compiled and loaded."""
    source = Path(__file__).with_name("reference_trial.c")
    with tempfile.TemporaryDirectory() as folder:
        library = str(Path(folder, "reference_trial.so"))
        command = [*c_compiler.compiler(), "-O3", "-shared", "-fPIC", "-o", library, str(source)]
        subprocess.run([*command, "-lm"], check=True)  # noqa: S603  the user's own compiler
        return ctypes.CDLL(library)


def hand_written(library: ctypes.CDLL, batch: Batch) -> Callable[[], FloatArray]:
    """The first trial of a batch by hand-written C, called through ctypes."""
    trial = library.reference_trial
    address, real, count = ctypes.c_void_p, ctypes.c_double, ctypes.c_long
    trial.argtypes = (address, address, real, count, count, real, *[address] * 6)
    trial.restype = count
    arrays = (batch.parameters, batch.coefficients, batch.setpoint_N, batch.noise_N)
    parameters, row, setpoint, noise = map(address_of, arrays)
    samples = len(batch.setpoint_N)

    def call() -> FloatArray:
        signals, flags = np.empty((3, samples)), np.empty(samples, np.uint8)
        outputs = address_of(signals)
        trial(
            *(parameters, row, batch.preload_N, batch.delay, samples, batch.bound_N),
            *(setpoint, noise, outputs, outputs + 8 * samples, outputs + 16 * samples),
            address_of(flags),
        )
        return signals

    return call


def address_of(array: Any) -> int:
    """Memory address of an array's data."""
    return ctypes.addressof(ctypes.c_char.from_buffer(array))
