"""How far to step: no further than a limit, and less while the search goes in circles.

A constant adaptation gain is too large for some costs: the centre then circles about the optimum
as far out as the limit lets it. Kesten's remedy for stochastic approximation (Annals of
Mathematical Statistics 29, 1958) is to shorten the steps as they keep changing direction. Here
every step u is multiplied by how straight the way has been over about one dither period,

    straightness = max(least, |mean u| / mean |u|)

one where all steps point alike and near zero where they cancel. It rises again by itself when the
steps find a direction, so the search still follows a plant that changes.
"""

import math

STRAIGHTNESS_LEAST = 0.1
"""Steps are never shortened more than this, or the search could not get going again."""


def clip_norm(step: tuple[float, ...], limit: float) -> tuple[float, ...]:
    """The step, shortened to a length of at most the limit."""
    length = math.hypot(*step)
    return step if length <= limit else tuple([limit * (s / length) for s in step])


def kesten_step(
    step: tuple[float, ...], drift: tuple[float, ...], path: float
) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """The step to be made of a step u that was wanted.

    Args:
        step: The step u.
        drift: Mean u so far; zero at first.
        path: Mean |u| so far; zero at first.

    Returns:
        The step multiplied by the straightness, and the means with u in them.
    """
    share = 1.0 / (4 * (len(step) + 1))  # one over the dither period
    drift = tuple([d + share * (s - d) for d, s in zip(drift, step, strict=True)])
    path += share * (math.hypot(*step) - path)
    straightness = max(STRAIGHTNESS_LEAST, math.hypot(*drift) / path) if path > 0.0 else 1.0
    return tuple([straightness * s for s in step]), drift, path
