"""Closed loops of several models or gains at once, as compiled C (`closed_loops.c`).

A search asks for thousands of them, each of a few hundred samples and angles, where NumPy takes
most of its time to begin. Without a compiler there are none, and the same is found without.
"""

import ctypes
import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.compiled import compiled, places
from estune.loop_model.model import Laws, LoopModel

_COUNTS = ("models", "laws", "loops", "order", "terms", "dead", "law_terms")
_COUNTS_OF_GRID = ("angles", "offsets", "before", "samples", "drawn")
_ARRAYS = ("coordinates", "numerators", "S", "T", "R", "filters", "grid", "about", "setpoint")
_ANSWERS = ("load", "noise", "stable", "margin", "peaks", "output", "effort", "noise_gains")


class _Task(ctypes.Structure):
    """Argument of `estune_closed_loops`."""

    _fields_ = (
        *((name, ctypes.c_long) for name in (*_COUNTS, *_COUNTS_OF_GRID)),
        *((name, ctypes.c_void_p) for name in (*_ARRAYS, *_ANSWERS)),
    )


class Inputs(NamedTuple):
    """What loops answer to.

    Attributes:
        before: Samples before the step, in which nothing moves.
        setpoint: Deviation from the step on, shape (samples - before,).
        load: Load from the step on, or None.
        noise: Noise of the measurement, shape (drawn,); None asks for variances after the
            step, which are known without a load alone.
    """

    before: int
    setpoint: FloatArray
    load: FloatArray | None = None
    noise: FloatArray | None = None


class ClosedLoops(NamedTuple):
    """Margins and answers of loops; those of an unstable one are not set.

    Attributes:
        stable: Whether each is stable, shape (loops,).
        margin_deg: Smallest phase margin, degrees.
        peaks: Largest |S| in each band, shape (loops, bands).
        output: Without noise, shape (loops, samples).
        effort: The same.
        noise: Variance of measurement and of a move of the effort per variance of the noise,
            shape (loops, 2); or the answers of both to the noise, shape (loops, 2, drawn).
    """

    stable: FloatArray
    margin_deg: FloatArray
    peaks: FloatArray
    output: FloatArray
    effort: FloatArray
    noise: FloatArray


def closed_loops(
    models: Sequence[LoopModel],
    laws: Laws,
    grid: tuple[FloatArray, FloatArray, int],
    inputs: Inputs | None = None,
) -> ClosedLoops | None:
    """The loops of models and controllers; None without a compiler.

    Args:
        models: Of one order and dead time; one for all controllers, or one for each.
        laws: One for all models, or one for each.
        grid: Angles of all models, shape (5, angles) as in the C source; the distances of further
            ones from a resonance in its half widths; the number of bands.
        inputs: What they answer to; None asks for margins only.

    Raises:
        MemoryError: there is not enough memory.
    """
    library = compiled("closed_loops")
    if library is None:
        return None
    table, about, bands = grid
    coordinates = np.array([model.coordinates for model in models])
    numerators = np.array([model.numerator for model in models])
    count = max(len(models), len(laws.setpoint))
    before, after, drawn, signals = 0, 0, 0, [0, 0, 0]
    if inputs is not None:
        signals = [0 if one is None else one.ctypes.data for one in inputs[1:]]
        before, after = inputs.before, inputs.setpoint.size
        drawn = 0 if inputs.noise is None else inputs.noise.size
    noise = (count, 2, drawn) if drawn else (count, 2)
    shapes = ((count,), (count,), (count, bands), *[(count, before + after)] * 2, noise)
    # One block of memory for each direction: an address takes longer to ask for than to fill.
    given = (coordinates, numerators, laws.measurement, laws.setpoint, laws.denominator)
    block = np.concatenate([one.ravel() for one in (*given, laws.filters)])
    from_block = places(block, [one.size for one in (*given, laws.filters)])
    sizes = [math.prod(shape) for shape in shapes]
    answers = np.empty(sum(sizes))
    asked = places(answers, sizes)
    task = _Task(
        *(len(models), len(laws.setpoint), count, *coordinates.shape[1:], *numerators.shape[1:]),
        *(models[0].dead_samples, laws.setpoint.shape[1]),
        *(table.shape[1], about.size, before, after, drawn),
        *from_block,
        *(table.ctypes.data, about.ctypes.data, *signals),
        *(asked if after else asked[:3]),
    )
    if library.estune_closed_loops(ctypes.byref(task)):
        raise MemoryError("no memory for closed loops; predict fewer at once")
    ends = [*accumulate(sizes)]
    parts = zip((0, *ends), ends, shapes, strict=False)
    return ClosedLoops(*(answers[begin:end].reshape(of) for begin, end, of in parts))
