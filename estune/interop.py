"""Exchange with python-control: controller, plant, and the margins of their loop."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.margins import Margins, SampledPlant, loop_margins, sample_plant
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import LinearModel

if TYPE_CHECKING:  # python-control takes more than a second to import
    from control import StateSpace, TransferFunction

__all__ = [
    "Margins",
    "as_control",
    "closed_loop",
    "linear_model",
    "margins",
    "sampled_controller",
    "sampled_plant",
]


def margins(model: LinearModel, gains: Gains, settings: ControllerSettings) -> Margins:
    """Gain and phase margin of the sampled loop of a plant and the PIDF, or its instability.

    The setpoint filter and the limits of the controller have no effect on them.
    """
    return loop_margins(sampled_model(model, settings), gains, settings)


def sampled_model(model: LinearModel, settings: ControllerSettings) -> SampledPlant:
    n = len(model.B)
    return sample_plant(
        np.reshape(np.asarray(model.A, dtype=np.float64), (n, n)),
        np.asarray(model.B, dtype=np.float64),
        np.asarray(model.C, dtype=np.float64),
        model.E,
        dead_time_s=model.dead_time_s,
        sample_s=1.0 / settings.sampling_Hz,
    )


def sampled_controller(gains: Gains, settings: ControllerSettings) -> "StateSpace":
    """The controller as it runs, sampled at the rig's rate, without its limits.

    Returns:
        A discrete state space of inputs `setpoint` and `measurement`, output `effort`, and the
        states of `estune.core.pidf.PidfState`.
    """
    from control import ss  # noqa: PLC0415  slow to import

    unlimited = replace(settings, output_min_N=-math.inf, output_max_N=math.inf)
    c = pidf.coefficients(unlimited, gains)
    columns = []
    for unit in np.eye(5):  # the difference equation is linear: its columns are its responses
        following, effort, _ = pidf.step(c, pidf.PidfState(*unit[:3]), unit[3], unit[4])
        columns.append([*following, effort])
    ABCD = np.array(columns).T
    return ss(
        *(ABCD[:3, :3], ABCD[:3, 3:], ABCD[3:, :3], ABCD[3:, 3:], 1.0 / settings.sampling_Hz),
        inputs=["setpoint", "measurement"],
        outputs=["effort"],
        states=list(pidf.PidfState._fields),
        name="pidf",
    )


def sampled_plant(
    plant: "LinearModel | TransferFunction | StateSpace",
    settings: ControllerSettings,
    dead_time_s: float = 0.0,
) -> "StateSpace":
    """A plant under zero-order hold with its dead time, as the controller meets it.

    Args:
        plant: A rig's linear model, or a continuous system of python-control.
        settings: The rate is taken from here.
        dead_time_s: Dead time of a system of python-control, s.

    Returns:
        A discrete state space from `effort` to `measurement`.

    Raises:
        InvalidInput: the plant is of another kind.
    """
    from control import ss  # noqa: PLC0415  slow to import

    model = plant if isinstance(plant, LinearModel) else linear_model(plant, dead_time_s)
    p = sampled_model(model, settings)
    n, late = p.C.size, p.delay + 1
    # States: x, then the last efforts, the latest first; y_k = C x_k + E u_{k-d-1}.
    A, B = np.zeros((n + late, n + late)), np.zeros((n + late, 1))
    A[:n, :n], A[:n, -1] = p.Phi, p.before
    A[n + 1 :, n:-1] = np.eye(late - 1)
    B[n] = 1.0
    if p.delay:
        A[:n, n + p.delay - 1] += p.now
    else:
        B[:n, 0] = p.now
    C = np.concatenate([p.C, np.zeros(p.delay), [p.E]])
    return ss(
        *(A, B, C[None, :], 0.0, 1.0 / settings.sampling_Hz),
        inputs=["effort"],
        outputs=["measurement"],
        name="plant",
    )


def closed_loop(
    plant: "LinearModel | TransferFunction | StateSpace",
    gains: Gains,
    settings: ControllerSettings,
    dead_time_s: float = 0.0,
) -> "StateSpace":
    """The sampled loop of a plant and the controller, without limits.

    Returns:
        A discrete state space from `setpoint` and `disturbance` (added to the effort) to
        `measurement` and `effort`.

    Raises:
        InvalidInput: the plant is of another kind.
    """
    from control import interconnect, summing_junction  # noqa: PLC0415  slow to import

    driven = sampled_plant(plant, settings, dead_time_s)
    driven.set_inputs(["drive"])
    return interconnect(
        [
            sampled_controller(gains, settings),
            summing_junction(["effort", "disturbance"], "drive"),
            driven,
        ],
        inputs=["setpoint", "disturbance"],
        outputs=["measurement", "effort"],
        name="loop",
    )


def linear_model(system: "TransferFunction | StateSpace", dead_time_s: float = 0.0) -> LinearModel:
    """The plant given as a transfer function or state space of python-control or SciPy.

    Args:
        system: Continuous, proper, single input (effort) and single output (measurement).
        dead_time_s: Dead time of the plant, s; python-control's systems have none of their own.

    Raises:
        InvalidInput: the system is of another kind, or the dead time is negative or not finite.
    """
    from control import StateSpace, TransferFunction  # noqa: PLC0415  slow to import
    from scipy.linalg import matrix_balance  # noqa: PLC0415  slow to import

    if not (math.isfinite(dead_time_s) and dead_time_s >= 0.0):
        raise InvalidInput(f"dead time is {dead_time_s} s; it must be finite, and zero or above")
    system = as_control(system)
    if not isinstance(system, (TransferFunction, StateSpace)):
        raise InvalidInput(
            f"the plant is a {type(system).__name__}; give a TransferFunction or StateSpace: "
            "linearise a nonlinear system with control.linearize, fit frequency data first"
        )
    check_siso(system)
    if not system.isctime():
        raise InvalidInput(
            f"the plant is discrete, sampled every {system.dt} s; give it in continuous time"
        )
    if isinstance(system, TransferFunction):
        A, B, C, E = _state_space(system)
    else:
        A, B, C, E = (
            np.asarray(part, dtype=np.float64) for part in (system.A, system.B, system.C, system.D)
        )
    if not all(np.isfinite(part).all() for part in (A, B, C, E)):
        raise InvalidInput("the plant has a coefficient that is not finite")
    if A.size:
        # The state matrix of fast modes has elements many decades apart.
        A, (scale, _) = matrix_balance(A, permute=False, separate=True)
        B, C = B / scale[:, None], C * scale
    return LinearModel(
        A=tuple(tuple(map(float, row)) for row in A),
        B=tuple(map(float, B.ravel())),
        C=tuple(map(float, C.ravel())),
        E=float(E[0, 0]),
        dead_time_s=float(dead_time_s),
    )


def as_control(system: Any) -> Any:
    """A linear system of SciPy as one of python-control; anything else as it is."""
    if not type(system).__module__.startswith("scipy.signal"):
        return system
    from control import ss, tf  # noqa: PLC0415  slow to import

    interval = () if system.dt is None else (system.dt,)
    if hasattr(system, "A"):
        return ss(system.A, system.B, system.C, system.D, *interval)
    ratio = system.to_tf()  # of a TransferFunction itself, or of zeros, poles and gain
    return tf(ratio.num, ratio.den, *interval)


def check_siso(system: Any) -> None:
    """Raises InvalidInput unless a system has one input and one output."""
    if (system.ninputs, system.noutputs) != (1, 1):
        raise InvalidInput(
            f"the plant has {system.ninputs} inputs and {system.noutputs} outputs; choose one of "
            "each, as in system[0, 0]"
        )


def _state_space(
    system: "TransferFunction",
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A, B, C and D of a transfer function.

    Time is counted in that of its poles, and the gain is one, for python-control takes numbers
    below 1e-14 for zero: of five lags of 1000 s all of the numerator.
    """
    from control import ss, tf  # noqa: PLC0415  slow to import

    num, den = (np.trim_zeros(np.asarray(part[0][0]), "f") for part in (system.num, system.den))
    if num.size > den.size:
        raise InvalidInput(
            "the plant has more zeros than poles; add the pole that bounds it at high frequency"
        )
    if not (np.isfinite(num).all() and np.isfinite(den).all()):
        raise InvalidInput("the plant has a coefficient that is not finite")
    rates = np.abs(np.roots(den))
    rates = rates[rates > 0.0]
    rate = math.exp(float(np.log(rates).mean())) if rates.size else 1.0
    num = num * rate ** np.arange(num.size - den.size, -den.size, -1.0)
    den = den * rate ** np.arange(0.0, -den.size, -1.0)
    gain = float(np.abs(num / den[0]).max(initial=0.0)) or 1.0
    states = ss(tf(num / gain if num.size else [0.0], den))
    A, B, C, E = (
        np.asarray(part, dtype=np.float64) for part in (states.A, states.B, states.C, states.D)
    )
    return rate * A, rate * B, gain * C, gain * E
