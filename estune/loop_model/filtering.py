"""Discrete filters; SciPy's signal processing (0.4 s, 28 MB) is loaded when they are used."""

from typing import Any

import numpy as np

from estune.core.quantities import FloatArray


def lfilter(numerator: Any, denominator: Any, samples: FloatArray) -> FloatArray:
    """Output of a filter that begins at rest, as of `scipy.signal.lfilter`."""
    from scipy import signal  # noqa: PLC0415  see above

    return np.asarray(signal.lfilter(numerator, denominator, samples))
