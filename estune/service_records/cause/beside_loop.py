"""A cause beside what the identified loop shows: its margins, and better gains."""

import math
from dataclasses import replace

from estune.service_records.cause.judge import TIGHT, Cause, Number, likeliest_cause

DEAR = 0.6
"""Cost of a step with the recommended gains, over that in use, up to which the cause names it: ten
sound logs gain 10 to 15 %, a setpoint filter or less effort up to 40 %."""

KNOWN = 0.975
"""Probability that Ms is above the lower end of its interval."""


def with_margins(cause: Cause, sensitivity: tuple[float, float, float] | None) -> Cause:
    """A cause beside the Ms of the loop with the ends of its 95 % interval, where it is known.

    A loop that is known to be too tight needs no wave from outside to swing, and is not called
    too slow, nor is one that is known not to be called too tight: the judge's own plant is a rough
    one, by which a loop of Ms 3 was too slow and ovens of Ms 1.1 to 1.4 had no margin.
    """
    is_tight = cause.name == "tuning" and cause.numbers["direction"] == "tight"
    if sensitivity is None:
        return cause
    if is_tight and sensitivity[2] < TIGHT:
        return of_others(cause)
    if sensitivity[1] <= TIGHT or is_tight:
        return cause
    value = sensitivity[0]
    Ms = f"Ms {value:.1f}" if math.isfinite(value) else "unstable"
    if cause.is_machine:
        return replace(cause, words=f"{cause.words}; the tuning is too tight as well, {Ms}")
    numbers: dict[str, Number] = {
        "direction": "tight",
        "sensitivity": value if math.isfinite(value) else None,
        "gain_factor": None,
    }
    return replace(
        cause,
        name="tuning",
        probability=KNOWN,
        numbers=numbers,
        words=f"too tight, {Ms}, by the gains that ran",
    )


def with_better(
    cause: Cause, sensitivity: float, relative_cost: float, load_error: float
) -> Cause:
    """A cause beside gains that are recommended, whose step and load cost so much less.

    What is said of the loop and of other gains is one: a loop whose gains may be far larger was
    told to have nothing wrong.
    """
    is_tight = cause.numbers.get("direction") == "tight"
    if relative_cost > DEAR or is_tight or cause.name not in ("none", "unknown", "tuning"):
        return cause
    less = f"a step costs {1.0 - relative_cost:.0%} less with the recommended gains"
    if load_error >= 1.0:
        return replace(cause, words=f"{cause.words}; {less}")
    numbers: dict[str, Number] = {
        "direction": "slow",
        "sensitivity": sensitivity,
        "gain_factor": None,
    }
    words = f"too slow, Ms {sensitivity:.2f}; {less}"
    return replace(cause, name="tuning", probability=KNOWN, numbers=numbers, words=words)


def of_others(cause: Cause) -> Cause:
    """The cause that is the likeliest of the others, where a told one is known not to be."""
    if cause.shown is None:
        return cause
    rest = 1.0 - cause.probabilities[cause.name] or 1.0
    weighed = {name: share / rest for name, share in cause.probabilities.items()}
    return likeliest_cause(cause.shown, weighed | {cause.name: 0.0}, cause.log)
