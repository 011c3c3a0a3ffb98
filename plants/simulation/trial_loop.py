"""The closed-loop trial, run as compiled C or in CasADi's virtual machine."""

import ctypes
import math
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from estune.core import pidf
from estune.core.quantities import FloatArray
from estune.errors import PlantError
from estune.hardware.compensation.plan import NO_COMPENSATION, CompensationTerms, KnownMotion
from estune.hardware.compensation.runtime import Compensation
from estune.support import c_compiler
from estune.trial import SATURATED
from plants.simulation.buffers import Buffers
from plants.simulation.c_source import c_source
from plants.simulation.compensation import TrialCompensation
from plants.simulation.compiled_structure import compiled
from plants.simulation.equations import Equations
from plants.simulation.plant import Columns

COEFFICIENTS = len(pidf.Coefficients._fields)
PIDF_STATES = len(pidf.PidfState._fields)
INTEGRAL = pidf.PidfState._fields.index("integral")
FILTERED_SETPOINT = pidf.PidfState._fields.index("filtered_setpoint")
TERMS = len(CompensationTerms._fields)


class Structure(Protocol):
    """Structure of a plant's equations: all but the numbers; hashable."""

    def equations(self) -> Equations:
        """The plant's equations of one sample."""


class Batch(NamedTuple):
    """Trials to run."""

    parameters: FloatArray  # the plant's, shape (parameters,) for all trials, or one row each
    coefficients: FloatArray  # the controllers', shape (trials, 9)
    preload_N: float  # setpoint at which each trial starts settled, N
    setpoint_N: FloatArray  # shape (samples,)
    noise_N: FloatArray | None  # shape (trials, samples), or None
    delay: int  # whole samples of dead time
    bound_N: float  # magnitude of the measurement at which a trial ends
    # Whether the setpoint is the effort, limited by the controllers' limits.
    open_loop: bool = False
    load_N: FloatArray | None = None  # added to the effort on its way to the plant, (samples,)
    compensation: TrialCompensation | None = None


@lru_cache(maxsize=64)
def trial_loop(structure: Structure) -> "CompiledLoop | CasadiLoop":
    """Trial loop of a structure, compiled if there is a compiler."""
    try:
        return CompiledLoop(structure)
    except PlantError as error:
        c_compiler.notice(str(error))
        return CasadiLoop(loop_functions(structure.equations()))


class Functions(NamedTuple):
    """Controller and plant together, as CasADi functions."""

    prepare: Any  # (parameters, preload) -> (constants, state, controller state, drive at rest)
    # (constants, state, present drive, noise, coefficients, controller state, setpoint, 1 in open
    # loop else 0, load, effort fed forward, taken off the measurement, the drive's limit or 0) ->
    # (state, measurement, angle, controller state, effort, drive, excess, tension outside: empty
    # where the plant has no gauge there).
    sense: Any
    substep: Any  # (constants, state, drive before, drive after, n) -> state
    move: Any  # (constants, state, drive before, drive after) -> state one sample later
    substeps: int  # number of substeps in a sample

    @property
    def has_reference(self) -> bool:
        """Whether the plant has a gauge outside."""
        return bool(self.sense.numel_out(7))


def loop_functions(plant: Equations, *, compensated: bool = True) -> Functions:
    """The closed loop of a plant and the PIDF.

    Args:
        compensated: Whether what is fed forward and taken off has any effect; where it has none,
            the compiler leaves it out, with the second sensing of each sample.
    """
    parameters, preload = plant.prepare.sx_in()
    constants, rest, rest_effort = plant.prepare(parameters, preload)
    _, rest_drive = plant.drive(constants, rest, rest_effort)
    start = ca.vertcat(*pidf.state_at_rest(preload, rest_effort))
    prepare = ca.Function(
        "estune_prepare", [parameters, preload], [constants, rest, start, rest_drive]
    )

    c, x, in_force, noise = plant.observe.sx_in()
    coefficients = ca.SX.sym("coefficients", COEFFICIENTS)
    memory, setpoint = ca.SX.sym("memory", PIDF_STATES), ca.SX.sym("setpoint")
    is_open, load = ca.SX.sym("is_open"), ca.SX.sym("load")
    beside = [ca.SX.sym(name) for name in ("forward", "off", "limit")]
    forward, off, limit = beside if compensated else [ca.SX(0)] * 3
    observed, measurement, angle = plant.observe(c, x, in_force, noise)
    controller = pidf.Coefficients(*ca.vertsplit(coefficients))
    low, high = controller.output_min_N, controller.output_max_N
    if compensated:
        most = ca.if_else(limit > 0, limit, ca.fmax(-low, high))
        low, high = ca.fmax(low, -most), ca.fmin(high, most)
    own = controller._replace(output_min_N=low - forward, output_max_N=high - forward)
    following, effort, excess = pidf.step(
        own, pidf.PidfState(*ca.vertsplit(memory)), setpoint, measurement - off
    )
    closed = effort + forward, excess
    effort, excess = (
        ca.if_else(is_open, one, other)
        for one, other in zip(pidf.limit_effort(controller, setpoint), closed, strict=True)
    )
    driven, drive = plant.drive(c, observed, effort + load)
    outside = ca.SX(0, 1) if plant.outside is None else plant.outside(c, observed)
    outputs = [driven, measurement, angle, ca.vertcat(*following), effort, drive, excess, outside]
    sense = ca.Function(
        "estune_sense",
        [c, x, in_force, noise, coefficients, memory, setpoint, is_open, load, *beside],
        [ca.densify(output) for output in outputs],  # C writes structural nonzeros only
    )
    *arguments, n = plant.substep.sx_in()
    substep = ca.Function("estune_substep", [*arguments, n], [plant.substep(*arguments, n)])
    move = ca.Function("estune_move", arguments, [plant.move(*arguments)])
    return Functions(prepare, sense, substep, move, plant.substeps)


class CompiledLoop:
    """The trial as a C library. Calls release the interpreter's lock."""

    def __init__(self, structure: Structure) -> None:
        """Compiles the loop of `trial_loop.c` without compensations; with them at the first use.

        Raises:
            PlantError: no compiler, or it failed.
        """
        self._structure = structure
        library = self._library(compensated=False)
        self._reference = bool(ctypes.c_int.in_dll(library, "estune_outside").value)
        self._plain = _trials(library)

    @cached_property
    def _compensated(self) -> Any:
        return _trials(self._library(compensated=True))

    def _library(self, *, compensated: bool) -> ctypes.CDLL:
        def source() -> str:
            functions = loop_functions(self._structure.equations(), compensated=compensated)
            return _source(functions, compensated=compensated)

        return compiled(self._structure, f"trial, compensated {compensated}", source)

    def run(self, batch: Batch) -> Columns:
        """Runs the trials, one after the other."""
        # Named references keep the arrays alive while C uses their addresses.
        parameters = np.ascontiguousarray(batch.parameters, np.float64)
        coefficients = np.ascontiguousarray(batch.coefficients, np.float64)
        setpoint = np.ascontiguousarray(batch.setpoint_N, np.float64)
        noise, load = (
            None if column is None else np.ascontiguousarray(column, np.float64)
            for column in (batch.noise_N, batch.load_N)
        )
        trials, samples = len(coefficients), len(setpoint)
        signals = np.empty((3 + self._reference, trials, samples))
        flags, ended = np.empty((trials, samples), np.uint8), np.empty(trials, np.int64)
        tension, signal_bytes = _address(signals), 8 * trials * samples
        compensation = batch.compensation
        beside = None if compensation is None else compensation.compiled()
        terms = None if beside is None else np.empty((trials, samples, TERMS))
        failed = (self._plain if beside is None else self._compensated)(
            *(trials, samples, batch.delay, batch.bound_N, batch.preload_N, batch.open_loop),
            _address(parameters),
            parameters.shape[1] if parameters.ndim > 1 else 0,
            _address(coefficients),
            _address(setpoint),
            None if load is None else _address(load),
            None if noise is None else _address(noise),
            samples,
            *(tension, tension + signal_bytes, tension + 2 * signal_bytes),
            tension + 3 * signal_bytes if self._reference else None,
            _address(flags),
            _address(ended),
            None if beside is None else beside.function,
            0 if beside is None else beside.size,
            0.0 if compensation is None else compensation.plan.period_s,
            None if terms is None else _address(terms),
        )
        if failed:
            raise MemoryError(f"no memory for a dead time of {batch.delay} samples")
        reference = signals[3] if self._reference else None
        return Columns(signals[0], signals[1], signals[2], flags, ended, reference, terms)


def _trials(library: ctypes.CDLL) -> Any:
    """The library's function that runs trials, with the types of its arguments."""
    trials = library.estune_trials
    address, count = ctypes.c_void_p, ctypes.c_long
    trials.argtypes = (
        *(count, count, count, ctypes.c_double, ctypes.c_double, ctypes.c_double),
        *(address, count, address, address, address, address, count),
        *(address, address, address, address, address, address),
        *(address, count, ctypes.c_double, address),
    )
    trials.restype = ctypes.c_int
    return trials


def _address(array: Any) -> int:
    """Address of an array's data; takes a fifth of the time of `array.ctypes.data`."""
    if array.flags.writeable and array.size:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    return int(array.__array_interface__["data"][0])


def _source(functions: Functions, *, compensated: bool) -> str:
    """The C file: sizes, generated functions, loop."""
    sizes = {
        "CONSTANTS": functions.prepare.numel_out(0),
        "STATES": functions.substep.numel_out(0),
        "SUBSTEPS": functions.substeps,
        "PIDF_STATES": PIDF_STATES,
        "COEFFICIENTS": COEFFICIENTS,
        "COMPENSATED": int(compensated),
        "OUTSIDE": int(functions.has_reference),
        "INTEGRAL": INTEGRAL,
        "FILTERED_SETPOINT": FILTERED_SETPOINT,
    }
    generated = (functions.prepare, functions.sense, functions.substep)
    return c_source(generated, sizes, Path(__file__).with_suffix(".c"))


class CasadiLoop:
    """The trial in CasADi's virtual machine, sample by sample through its buffers."""

    def __init__(self, functions: Functions) -> None:
        self._functions = functions

    def run(self, batch: Batch) -> Columns:
        """Runs the trials, one after the other."""
        trials, samples = len(batch.coefficients), len(batch.setpoint_N)
        columns = Columns.empty(trials, samples, reference=self._functions.has_reference)
        if batch.compensation is not None:
            columns = columns._replace(terms=np.empty((trials, samples, TERMS)))
        parameters = np.broadcast_to(batch.parameters, (trials, batch.parameters.shape[-1]))
        noise = np.zeros((1, samples)) if batch.noise_N is None else batch.noise_N
        noise = np.broadcast_to(noise, (trials, samples))
        machine = VirtualMachine(self._functions)
        for n in range(trials):
            machine.start(parameters[n], batch.preload_N, batch.coefficients[n])
            one = columns.trial(n)
            columns.ended[n] = machine.trial(batch, noise[n], one)
        return columns


class VirtualMachine(Buffers):
    """One trial at a time through CasADi's buffers.

    Attributes:
        prepare: Computes the constants and the state at rest from parameters and preload.
        sense: One sample of gauge, encoder and controller; see `Functions`.
        move: The plant to the next sample.
    """

    def __init__(self, functions: Functions) -> None:
        prepare, sense, _, move, _ = functions
        scalars = ["preload", "setpoint", "is_open", "load", "noise", "before", "after"]
        scalars += ["y", "angle", "effort", "drive", "excess", "forward", "off", "limit"]
        room = dict.fromkeys(scalars, 1)
        room |= {
            "reference": sense.numel_out(7),
            "parameters": prepare.numel_in(0),
            "coefficients": COEFFICIENTS,
        }
        room |= {"constants": prepare.numel_out(0), "pidf": PIDF_STATES, "following": PIDF_STATES}
        room |= {"state": move.numel_out(0), "driven": move.numel_out(0)}
        super().__init__(room)
        self.prepare = self.bind(prepare, "parameters preload", "constants state pidf drive")
        self.sense = self.bind(
            sense,
            "constants state before noise coefficients pidf setpoint is_open load "
            "forward off limit",
            "driven y angle following effort drive excess reference",
        )
        self.move = self.bind(move, "constants driven before after", "state")

    def start(self, parameters: FloatArray, preload_N: float, coefficients: FloatArray) -> None:
        """Starts a trial with controller and plant at rest."""
        self.memory["parameters"][:] = np.ascontiguousarray(parameters).data
        self.memory["coefficients"][:] = np.ascontiguousarray(coefficients).data
        self.memory["preload"][0] = preload_N
        self.prepare()

    def set_parameters(self, parameters: FloatArray) -> None:
        """Continues the trial with other parameters: only the constants change."""
        saved = {name: np.array(self.memory[name]) for name in ("state", "pidf", "drive")}
        self.memory["parameters"][:] = np.ascontiguousarray(parameters).data
        self.prepare()
        for name, values in saved.items():
            self.memory[name][:] = values.data

    def trial(self, batch: Batch, noise_N: FloatArray, columns: Columns) -> int:
        """Runs the loop of `trial_loop.c`; returns its end index."""
        m, size = self.memory, batch.delay + 2
        beside = None if batch.compensation is None else batch.compensation.plain()
        ring = [m["drive"][0]] * size
        m["is_open"][0] = batch.open_loop
        for k, (setpoint, noise) in enumerate(
            zip(batch.setpoint_N.tolist(), noise_N.tolist(), strict=True)
        ):
            m["load"][0] = 0.0 if batch.load_N is None else batch.load_N[k]
            m["forward"][0] = m["off"][0] = m["limit"][0] = 0.0
            m["setpoint"][0], m["noise"][0], m["before"][0] = setpoint, noise, ring[k % size]
            self.sense()
            y = m["y"][0]
            if beside is not None and columns.terms is not None:
                columns.terms[k] = self._compensate(beside, batch, k)
            columns.tension_N[k], columns.effort_N[k] = y, m["effort"][0]
            columns.angle_rad[k] = m["angle"][0]
            if columns.reference_N is not None:
                columns.reference_N[k] = m["reference"][0]
            if not -batch.bound_N <= y <= batch.bound_N:
                return k
            columns.flags[k] = SATURATED if m["excess"][0] else 0
            m["pidf"][:] = m["following"]
            ring[(k + batch.delay + 1) % size] = m["drive"][0]
            m["after"][0] = ring[(k + 1) % size]
            self.move()
        return len(batch.setpoint_N)

    def _compensate(self, beside: Compensation, batch: Batch, k: int) -> CompensationTerms:
        """Senses a sample again with its compensations, as the loop of `trial_loop.c` does."""
        m = self.memory
        known = KnownMotion(math.nan if batch.open_loop else m["pidf"][FILTERED_SETPOINT])
        assert batch.compensation is not None  # noqa: S101  the caller has made it
        time_s = k * batch.compensation.plan.period_s
        terms = beside.sample(time_s, m["y"][0], m["angle"][0], known)
        if batch.open_loop:
            terms = NO_COMPENSATION._replace(velocity_rad_s=terms.velocity_rad_s)
        m["forward"][0], m["off"][0] = terms.feed_forward_N, terms.off_gauge_N
        m["limit"][0] = terms.limit_N
        if k == 0:
            m["pidf"][INTEGRAL] -= terms.feed_forward_N
        self.sense()
        return terms
