"""A platform held by four reels and a two-reel bench, and the process that serves their reels."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from estune.support.child_process import child_process, next_line
from plants.bench.cable_platform.mechanism import Mechanism, bench_carriage, planar_platform
from plants.models.reel import reference_reel

_END_WITHIN_S = 10.0


def platform() -> tuple[Mechanism, tuple[str, ...]]:
    """A light platform in a vertical plane, its four eyelets in the corners of a rectangle.

    Its cables cross, so that they exert a moment; the eyelets lose 1 %.
    """
    corners = ((-0.8, -0.6), (0.8, -0.6), (0.8, 0.6), (-0.8, 0.6))
    ends = ((-0.1, 0.05), (0.1, 0.05), (0.1, -0.05), (-0.1, -0.05))
    made = planar_platform(corners, ends, mass_kg=1.0, inertia_kg_m2=0.015, attenuation=0.99)
    return made, ("lower-left", "lower-right", "upper-right", "upper-left")


def bench() -> tuple[Mechanism, tuple[str, ...]]:
    """Two reference reels face to face, both eyelets with C_R = 0.1 and a bend of 2.1 rad."""
    tangent = 0.1 / math.sqrt(1.0 - 0.1**2)  # of the friction angle, whose sine is C_R
    B = math.exp(-2.0 * math.asinh(tangent * math.cos(2.1 / 2.0)))  # (22)
    reel = reference_reel()
    return bench_carriage(reel, reel, (B, B)), ("x", "y")


EXAMPLES: Mapping[str, Callable[[], tuple[Mechanism, tuple[str, ...]]]] = {
    "platform": platform,
    "bench": bench,
}
"""The platform that `python -m plants.bench.cable_platform` serves."""


@contextmanager
def served(name: str) -> Iterator[dict[str, str]]:
    """Serves the reels of an example in a process of its own, for the duration of the block.

    Ctrl-C does not reach them.

    Yields:
        Their endpoints by name.

    Raises:
        RigError: the process ends at once.
    """
    module = ("plants.bench.cable_platform", name)
    with child_process(*module, end_within_s=_END_WITHIN_S, start_new_session=True) as process:
        lines = [next_line(process).split() for _ in EXAMPLES[name]()[1]]
        yield {words[1]: words[-1] for words in lines}
