"""The form in which a controller runs its difference equation."""

from dataclasses import dataclass, fields
from typing import Literal


@dataclass(frozen=True, slots=True)
class ControllerForm:
    """The form of a controller's difference equation; the defaults are those of `pidf`.

    Attributes:
        structure: `parallel`, P + I/s + D s, or `series`, (P + I/s)(1 + D/P s).
        integral: Rule by which the error is integrated.
        derivative: Rule of the derivative filter.
        derivative_on: Signal whose derivative is taken.
        filter_on: Signal that the derivative filter acts on: the derivative alone, or all of the
            measurement.
        setpoint_filter: Rule of the setpoint filter.
    """

    structure: Literal["parallel", "series"] = "parallel"
    integral: Literal["forward", "backward", "tustin"] = "forward"
    derivative: Literal["backward", "tustin", "exact", "exponential"] = "backward"
    derivative_on: Literal["measurement", "error"] = "measurement"
    filter_on: Literal["derivative", "measurement"] = "derivative"
    setpoint_filter: Literal["exact", "backward", "tustin"] = "exact"

    def __str__(self) -> str:
        """What differs from the form of `pidf`, in words; `as estune's own` where nothing does."""
        usual = ControllerForm()
        differs = [
            f"{field.name.replace('_', ' ')}: {value}"
            for field in fields(self)
            if (value := getattr(self, field.name)) != getattr(usual, field.name)
        ]
        return ", ".join(differs) or "as estune's own"


OWN_FORM = ControllerForm()
"""The form of `estune.core.pidf`."""
