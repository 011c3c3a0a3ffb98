"""Fig. 9: how does the reel's bandwidth depend on the cable's length?"""

from itertools import pairwise

from experiments.identification import LENGTHS_m
from experiments.paper import PaperFigure, show
from experiments.paper.bandwidth import draw, measure, power, string_Hz
from plants.models.reel import Reel

TENSION_N = 15.0


def make(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one record each is quick enough
    """The figure."""
    found = measure([Reel(length, TENSION_N) for length in LENGTHS_m])
    damping = [each.fit.damping for each in found]
    peaks = [each.fit.resonance_Hz.value for each in found]
    growth = power(list(LENGTHS_m), [each.value for each in damping])
    shift = power(list(LENGTHS_m), peaks)
    string = power(list(LENGTHS_m), [string_Hz(each.reel) for each in found])
    apart = all(b.low > a.high for a, b in pairwise(damping))
    gauges = [each.fit.gauge_Hz.value for each in found if each.fit.gauge_Hz is not None]
    return PaperFigure(
        number=9,
        title="Bandwidth of the reel for a constant tension and four cable lengths",
        claim="The reel does not exactly respond as a string instrument, and the cable's length "
        "has a proportional influence on the damping.",
        holds=apart and growth.value > 0.5 and abs(shift.value) < abs(string.value),
        measured=f"From {LENGTHS_m[0]:g} to {LENGTHS_m[-1]:g} m the damping ratio rises from "
        f"{damping[0].value:.4f} to {damping[-1].value:.4f}, as the length to the power {growth}; "
        f"the resonance falls from {peaks[0]:.1f} to {peaks[-1]:.1f} Hz, power {shift}, where a "
        f"string's (31) has {string.rounded}. The gauge's own peak stands at "
        f"{sum(gauges) / len(gauges):.1f} Hz, near half the sampling rate, "
        f"{0.5 * found[0].reel.sampling_Hz:g} Hz, as the paper sees it.",
        rule="Damping rises from each length to the next by more than its 95 % intervals, its "
        "power of the length is nearer to one (in proportion) than to none, and the resonance "
        "depends on the length less than a string's.",
        caveat="Friction that grows with the length is built into the reference reel, which takes "
        "it from this figure: what is shown is that it can be measured, and that it makes the "
        "damping nearly proportional. The paper reads it from (31), which has no damping in it.",
        numbers={
            "power_of_damping": growth.value,
            "power_of_resonance": shift.value,
            "power_of_a_string": string.value,
            "damping_short": damping[0].value,
            "damping_long": damping[-1].value,
        },
        figure=draw({f"{each.reel.cable_length_m:g} m": each for each in found}),
    )


if __name__ == "__main__":
    show(make())
