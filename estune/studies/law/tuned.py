"""What one finished tuning brings to the law: where it stood, what it found, how well it knows."""

import math
from dataclasses import dataclass

from estune.core.gains import Gains
from estune.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class TunedGains:
    """The gains a tuning found at one cable length and tension.

    Attributes:
        label: What to call it in messages, such as a cell of a sweep or a run's folder.
        length_m: Cable length it was tuned at, m.
        tension_N: Tension it was tuned at, N.
        gains: What it found.
        log_errors: Standard errors of (ln P, ln I, ln D, ln tau_F), or None where the tuner gives
            none; a gain without one is infinite or not a number there.
        cost: Cost (35) at those gains.
        cost_error: Its standard error; zero where it is not known.
        safe: Whether the gains are safe to run.
        converged: Whether the search had come to its end.

    Raises:
        InvalidInput: length or tension is not finite and above zero, or the errors are not four,
            or one of them is negative.
    """

    label: str
    length_m: float
    tension_N: float
    gains: Gains
    log_errors: tuple[float, ...] | None
    cost: float
    cost_error: float
    safe: bool
    converged: bool

    def __post_init__(self) -> None:
        for what, value, unit in (
            ("cable length", self.length_m, "m"),
            ("tension", self.tension_N, "N"),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(
                    f"{self.label}: {what} is {value} {unit}; it must be finite and above zero"
                )
        if self.log_errors is None:
            return
        if len(self.log_errors) != 4 or any(error < 0.0 for error in self.log_errors):
            raise InvalidInput(
                f"{self.label}: log_errors are {self.log_errors}; give the standard errors of "
                "ln P, ln I, ln D and ln tau_F, zero or above, or None"
            )
