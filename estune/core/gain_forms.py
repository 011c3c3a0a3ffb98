"""The gains in the forms that other controllers take, and gains backed off for margin."""

import math
from dataclasses import replace
from typing import NamedTuple

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput


class GainForm(NamedTuple):
    """The gains as one kind of controller takes them.

    In every form the derivative acts on the measurement alone, through a first-order filter, and
    the setpoint passes the filter 1/(tau_F s + 1).

    Attributes:
        name: `parallel`, `standard`, `series` or `per_sample`.
        equation: From the error e (measurement y for the derivative) to the effort u.
    """

    name: str
    equation: str
    values: dict[str, float]


def gain_forms(gains: Gains, settings: ControllerSettings) -> tuple[GainForm, ...]:
    """The gains in every form in which they can be written.

    The series form, of pneumatic origin, has real zeros only: it is left out where Ti < 4 Td. The
    numbers per sample hold at the rig's rate alone; at another rate take those in seconds.
    """
    K, Ti, Td = gains.to_standard()
    rate = settings.sampling_Hz
    forms = [
        GainForm("parallel", "u = P e + I int(e) - D dy/dt", _values(P=K, I=gains.I, D=gains.D)),
        GainForm("standard", "u = Kp (e + int(e)/Ti - Td dy/dt)", _values(Kp=K, Ti_s=Ti, Td_s=Td)),
        GainForm(
            "per_sample",
            f"u = P e + I_k sum(e) - D_k (y - y_before), at {rate:g} Hz",
            _values(P=K, I_k=gains.I / rate, D_k=gains.D * rate),
        ),
    ]
    if Ti >= 4.0 * Td:
        share = 0.5 * (1.0 + math.sqrt(1.0 - 4.0 * Td / Ti))
        equation = "C = Kp (1 + 1/(Ti s)) (1 + Td s)"
        series = _values(Kp=K * share, Ti_s=Ti * share, Td_s=Td / share)
        forms.insert(2, GainForm("series", equation, series))
    return tuple(forms)


def backed_off(gains: Gains, share: float) -> Gains:
    """Gains whose loop gain is lower by a share at every frequency; the filter stays.

    A gain margin g becomes g / (1 - share).

    Raises:
        InvalidInput: the share is not between 0 and 1.
    """
    if not 0.0 <= share < 1.0:
        raise InvalidInput(f"the gains are backed off by {share:g}; give a share from 0 to 1")
    left = 1.0 - share
    return replace(gains, P=left * gains.P, I=left * gains.I, D=left * gains.D)


def _values(**values: float) -> dict[str, float]:
    return values
