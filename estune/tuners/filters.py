"""The two filters of extremum seeking, one trial per step, and what a sinusoid keeps of them.

The washout filter (z - 1)/(z + h) takes the slowly changing part out of the cost; the low-pass
l/(1 - (1 - l)/z) takes the dither's harmonics and the noise out of the demodulated signal.
"""

import cmath


def washout_at_rest(h: float, level: float) -> float:
    """The washout's state zeta after a long time at one level, where its output is zero."""
    return level / (1.0 + h)


def washout(h: float, zeta: float, level: float) -> tuple[float, float]:
    """One step of (z - 1)/(z + h), as Killingsworth & Krstic (2006) write it.

        zeta(k) = -h zeta(k-1) + J(k-1),    output(k) = J(k) - (1 + h) zeta(k)

    Args:
        h: Position of the pole, 0 < h < 1; it lies at -h.
        zeta: State zeta(k).
        level: Input J(k).

    Returns:
        The output at k and the state zeta(k+1).
    """
    return level - (1.0 + h) * zeta, -h * zeta + level


def washout_response(h: float, frequency: float) -> tuple[float, float]:
    """Gain and phase lead in rad of the washout at a frequency in rad/trial."""
    z = cmath.exp(1j * frequency)
    response = (z - 1.0) / (z + h)
    return abs(response), cmath.phase(response)


def low_pass(share: float, level: float, signal: float) -> float:
    """One step of the first-order low-pass with unit gain at rest: the share of what is new."""
    return level + share * (signal - level)
