"""The reference trial, independently of the simulation: in C and as a python-control system."""

import ctypes
import math
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import control
import numpy as np
from scipy.linalg import expm

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.support import c_compiler
from plants.models.reel import Reel
from plants.models.reel_equations import cable_stiffness_N_m, viscous_friction_Nms
from plants.simulation.trial_loop import Batch


def reference_library() -> ctypes.CDLL:
    """reference_trial.c, compiled and loaded."""
    source = Path(__file__).with_name("reference_trial.c")
    with tempfile.TemporaryDirectory() as folder:
        library = str(Path(folder, "reference_trial.so"))
        command = [*c_compiler.compiler(), "-O3", "-shared", "-fPIC", "-o", library, str(source)]
        subprocess.run([*command, "-lm"], check=True)  # noqa: S603  the user's own compiler
        return ctypes.CDLL(library)


def hand_written(library: ctypes.CDLL, batch: Batch) -> Callable[[], FloatArray]:
    """The first trial of a batch by hand-written C, called through ctypes."""
    trial = library.reference_trial
    address, real, count = ctypes.c_void_p, ctypes.c_double, ctypes.c_long
    trial.argtypes = (address, address, real, count, count, real, *[address] * 6)
    trial.restype = count
    arrays = (batch.parameters, batch.coefficients, batch.setpoint_N, batch.noise_N)
    parameters, row, setpoint, noise = map(address_of, arrays)
    samples = len(batch.setpoint_N)

    def call() -> FloatArray:
        signals, flags = np.empty((3, samples)), np.empty(samples, np.uint8)
        outputs = address_of(signals)
        trial(
            *(parameters, row, batch.preload_N, batch.delay, samples, batch.bound_N),
            *(setpoint, noise, outputs, outputs + 8 * samples, outputs + 16 * samples),
            address_of(flags),
        )
        return signals

    return call


def address_of(array: Any) -> int:
    """Memory address of an array's data."""
    return ctypes.addressof(ctypes.c_char.from_buffer(array))


def nonlinear_system(reel: Reel, gains: Gains, friction_Nm: float) -> Any:
    """The nonlinear trial as a discrete-time system of python-control."""
    k = cable_stiffness_N_m(reel, reel.profile.preload_N)
    R, J, b = reel.drum_radius_m, reel.drum_inertia_kg_m2, viscous_friction_Nms(reel)
    w, zeta, h = 2 * math.pi * reel.gauge_Hz, reel.gauge_damping, 0.25 / reel.sampling_Hz
    A = np.zeros((6, 6))  # theta, omega, g, g', and the inputs torque and tension less k R theta
    A[0, 1], A[1, :2] = 1.0, (-k * R * R / J, -b / J)
    A[2, 3], A[3, :4] = 1.0, (w * w * k * R, 0.0, -w * w, -2.0 * zeta * w)
    A[1, 4], A[1, 5], A[3, 5] = 1.0 / J, -R / J, w * w
    both = expm(A * h)
    Phi, torque, beyond = both[:4, :4], both[:4, 4], both[:4, 5]
    c = pidf.coefficients(reel.controller, gains)
    Kt, limit, F = reel.torque_constant_Nm_A, reel.current_limit_A, friction_Nm

    def update(_t: float, x: FloatArray, u: FloatArray, _p: Any) -> FloatArray:
        body, memory, current = x[:4], pidf.PidfState(*x[4:7].tolist()), x[7]
        memory, effort, _ = pidf.step(c, memory, u[0], body[2] + u[1])
        for _ in range(4):
            linear = k * R * (body[0] + 0.5 * h * body[1])
            free = Phi @ body + torque * (Kt * current) + beyond * (max(linear, 0.0) - linear)
            body = free + torque * min(max(-free[1] / torque[1], -F), F)
        return np.array([*body, *memory, min(max(effort * R / Kt, -limit), limit)])

    def output(_t: float, x: FloatArray, u: FloatArray, _p: Any) -> FloatArray:
        return np.array([x[2] + u[1]])

    return control.nlsys(update, output, inputs=2, outputs=1, states=8, dt=1.0 / reel.sampling_Hz)


def nonlinear_start(reel: Reel) -> FloatArray:
    """State of `nonlinear_system` at rest."""
    preload = reel.profile.preload_N
    theta = preload / (cable_stiffness_N_m(reel, preload) * reel.drum_radius_m)
    current = preload / reel.newtons_per_ampere
    return np.array([theta, 0.0, preload, 0.0, preload, preload, preload, current])
