"""The PIDF as the loop runs it: compiled from the text for firmware, or plain Python.

All efforts are those of the motor: the controller's own and the feed-forward beside it.
"""

import ctypes
import math

from estune.core import pidf
from estune.core.pidf import Coefficients, PidfState
from estune.errors import PlantError
from estune.hardware.firmware import COEFFICIENTS, STATES
from estune.support import c_compiler

_LIMITS = slice(
    Coefficients._fields.index("output_min_N"), Coefficients._fields.index("output_max_N") + 1
)
_FILTERED = pidf.PidfState._fields.index("filtered_setpoint")
_EXPORT = '#define ESTUNE_PIDF_EXPORT __attribute__((visibility("default")))\n'


class _Struct(ctypes.Structure):
    _fields_ = (
        ("coefficients", ctypes.c_double * COEFFICIENTS),
        ("state", ctypes.c_double * STATES),
    )


class _Limits:
    """Limits of the effort, and the feed-forward within them.

    Attributes:
        drive_N: Greatest size of the effort that the drive gives; zero where it is the rig's.
    """

    limits_N = (-math.inf, math.inf)
    forward_N = 0.0
    drive_N = 0.0

    @property
    def own_limits_N(self) -> tuple[float, float]:
        """Limits of the controller's own effort, N; the anti-windup knows them."""
        low, high = self._in_force_N
        return low - self.forward_N, high - self.forward_N

    def total_N(self, own_N: float) -> float:
        """The motor's effort for one of the controller; rounding does not pass the limits."""
        low, high = self._in_force_N
        return min(max(own_N + self.forward_N, low), high)

    @property
    def _in_force_N(self) -> tuple[float, float]:
        low, high = self.limits_N
        drive = self.drive_N or math.inf
        return max(low, -drive), min(high, drive)


class CompiledController(_Limits):
    """The C text, compiled."""

    def __init__(self, source: str) -> None:
        """Compiles the text, or takes it from the cache.

        Raises:
            PlantError: no compiler, or it failed.
        """
        library = c_compiler.load(_EXPORT + source)
        self._step, self._take_over, self._rest = (
            library.estune_pidf_step,
            library.estune_pidf_take_over,
            library.estune_pidf_at_rest,
        )
        number, address = ctypes.c_double, ctypes.c_void_p
        self._step.argtypes, self._step.restype = (address, number, number, address), number
        self._take_over.argtypes, self._take_over.restype = (address, number, number, number), None
        self._rest.argtypes, self._rest.restype = (address, number, number), None
        self._struct, self._excess = _Struct(), ctypes.c_double()
        self._at, self._excess_at = map(ctypes.addressof, (self._struct, self._excess))
        self.limited = False

    def use(self, coefficients: Coefficients) -> None:
        """Changes the gains and keeps the state."""
        self._struct.coefficients[:] = coefficients
        self.limits_N = coefficients.output_min_N, coefficients.output_max_N
        self.beside(self.forward_N, self.drive_N)

    def beside(self, forward_N: float, drive_N: float) -> None:
        """Sets the effort beside that of the controller and the drive's limit, from here on."""
        self.forward_N, self.drive_N = forward_N, drive_N
        self._struct.coefficients[_LIMITS] = self.own_limits_N

    @property
    def filtered_setpoint_N(self) -> float:
        """Setpoint after its filter at the last step, N."""
        return float(self._struct.state[_FILTERED])

    def rest(self, tension_N: float, effort_N: float) -> None:
        """Takes the state of a settled loop."""
        self._rest(self._at, tension_N, effort_N - self.forward_N)

    def take_over(self, setpoint_N: float, tension_N: float, effort_N: float) -> None:
        """Takes the state from which the next step gives this effort."""
        self._take_over(self._at, setpoint_N, tension_N, effort_N - self.forward_N)

    def exchange(self, coefficients: Coefficients, setpoint_N: float, tension_N: float) -> None:
        """Changes the gains so that the next step gives the effort it would have given."""
        state = self._struct.state[:]
        effort = self._step(self._at, setpoint_N, tension_N, self._excess_at) + self._excess.value
        self._struct.state[:] = state
        self.use(coefficients)
        self._take_over(self._at, setpoint_N, tension_N, effort)

    def step(self, setpoint_N: float, tension_N: float) -> float:
        """One sample; the effort within its limits, N."""
        effort: float = self._step(self._at, setpoint_N, tension_N, self._excess_at)
        self.limited = self._excess.value != 0.0
        return self.total_N(effort)


class PlainController(_Limits):
    """`estune.core.pidf` on floats."""

    _coefficients: Coefficients

    def __init__(self) -> None:
        self._state = PidfState(0.0, 0.0, 0.0)
        self.limited = False

    def use(self, coefficients: Coefficients) -> None:
        """Changes the gains and keeps the state."""
        self.limits_N = coefficients.output_min_N, coefficients.output_max_N
        self._coefficients = coefficients
        self.beside(self.forward_N, self.drive_N)

    def beside(self, forward_N: float, drive_N: float) -> None:
        """Sets the effort beside that of the controller and the drive's limit, from here on."""
        self.forward_N, self.drive_N = forward_N, drive_N
        low, high = self.own_limits_N
        self._coefficients = self._coefficients._replace(output_min_N=low, output_max_N=high)

    @property
    def filtered_setpoint_N(self) -> float:
        """Setpoint after its filter at the last step, N."""
        return float(self._state.filtered_setpoint)

    def rest(self, tension_N: float, effort_N: float) -> None:
        """Takes the state of a settled loop."""
        self._state = pidf.state_at_rest(tension_N, effort_N - self.forward_N)

    def take_over(self, setpoint_N: float, tension_N: float, effort_N: float) -> None:
        """Takes the state from which the next step gives this effort."""
        self._state = pidf.bumpless(
            *(self._coefficients, self._state, setpoint_N, tension_N),
            effort_N - self.forward_N,
        )

    def exchange(self, coefficients: Coefficients, setpoint_N: float, tension_N: float) -> None:
        """Changes the gains so that the next step gives the effort it would have given."""
        self._state = pidf.bumpless_exchange(
            self._coefficients, coefficients, self._state, setpoint_N, tension_N
        )
        self.use(coefficients)

    def step(self, setpoint_N: float, tension_N: float) -> float:
        """One sample; the effort within its limits, N."""
        self._state, effort, excess = pidf.step(
            self._coefficients, self._state, setpoint_N, tension_N
        )
        self.limited = bool(excess != 0.0)
        return self.total_N(float(effort))


Controller = CompiledController | PlainController
"""One controller with its state. `limited` says whether its limits cut the last effort."""


def make_controller(source: str) -> tuple[Controller, str]:
    """The controller compiled from its C text, or the plain one where there is no compiler.

    Returns:
        The controller, and why it is the plain one; empty where it is not.
    """
    try:
        return CompiledController(source), ""
    except PlantError as error:
        return PlainController(), f"the controller runs as plain Python: {error}"
