"""A reel whose far cable end moves during a trial, under scheduled or fixed gains.

The end moves outward by s(t) = L(t) - L(0). With the drum's angle phi, positive when winding in,
the cable is stretched by theta = phi + s/R, and the drum obeys, in terms of theta,

    J theta'' + b theta' + R T = Kt i + (J s'' + b s')/R,    b = b_0 + b_L L,    T = k(L) R theta,

the equations of `plants.models.reel_equations` with one more torque, and k and b at the length of
each sample. Cable that is paid out has the strain of the deployed cable: a change of length alone
does not change the tension, T' = k(L) (R phi' + s'), and theta is scaled by k before over k after.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.core.schedule import GainSchedule
from estune.errors import InvalidInput
from estune.hardware.live_gains import LengthSource, LiveGains
from estune.trial import SATURATED
from estune.trial.profiles import AnyProfile
from plants.models.reel import Reel
from plants.models.reel_equations import cable_stiffness_N_m, viscous_friction_Nms
from plants.models.reel_signal_path import THETA
from plants.simulation.batch import Response, divergence_limit_N
from plants.simulation.plant import drive_of
from plants.simulation.trial_loop import VirtualMachine, loop_functions


def simulate_moving(
    reel: Reel,
    gains: GainSchedule | Gains,
    length_m: FloatArray,
    profile: AnyProfile | None = None,
) -> Response:
    """Runs one closed-loop trial with a changing cable length.

    Scheduled gains follow the drum's angle, at the profile's preload, without a jump of the effort
    (`estune.hardware.live_gains`).

    Args:
        reel: The reel; its own length is ignored.
        gains: A schedule, or fixed gains.
        length_m: Deployed length at each sample, m, shape (samples,); smooth, because its second
            derivative is a force.
        profile: The setpoint; None is the reel's own step.

    Returns:
        The trial, with the drum's angle phi.

    Raises:
        InvalidInput: the length has another shape than the trial, a length is not above
            zero, the profile is open-loop, or the reel has effects, which assume a fixed end.
        PlantError: the reel cannot be simulated.
    """
    profile = profile or reel.profile
    drive = drive_of(profile, reel.sampling_Hz)
    samples = len(drive.time_s)
    _check(reel, length_m, samples, open_loop=drive.open_loop)
    live = _live(reel, gains, float(length_m[0]), drive.preload_N)
    trial = _Trial(reel, length_m, drive.preload_N, live)
    limit = divergence_limit_N(profile)
    for k, setpoint in enumerate(drive.setpoint_N.tolist()):
        if not trial.sample(k, setpoint) <= limit:
            return trial.response(drive.time_s, drive.setpoint_N, k)
    return trial.response(drive.time_s, drive.setpoint_N, None)


class _Trial:
    """State of a running trial."""

    def __init__(
        self, reel: Reel, length_m: FloatArray, preload_N: float, live: LiveGains
    ) -> None:
        shortest = replace(reel, cable_length_m=float(length_m.min()))
        # The encoder is on the drum: phi is rounded, not theta.
        structure = replace(shortest.structure, rounded=False)
        self._machine = VirtualMachine(loop_functions(structure.equations()))
        self._parameters = shortest.parameter_values.copy()
        self._place = structure.parameter_names.index("cable_length_m")
        self._parameters[self._place] = length_m[0]
        self._machine.start(self._parameters, preload_N, np.array(live.coefficients))
        self._reel, self._length_m, self._live = reel, length_m, live
        self._preload_N = preload_N
        self._stretch = _stretch(reel, length_m, preload_N)
        self._current_A = _current_of_motion(reel, length_m)
        self._scaled_rad = 0.0  # change of theta by scaling, without a turn of the drum
        self._delay = reel.delay_samples
        self._ring = [self._machine.memory["drive"][0]] * (self._delay + 2)
        self._columns = np.zeros((3, len(length_m)))
        self._flags = np.zeros(len(length_m), np.uint8)

    def sample(self, k: int, setpoint_N: float) -> float:
        """Runs one sample; returns the magnitude of the measurement."""
        m, ring, size = self._machine.memory, self._ring, len(self._ring)
        m["setpoint"][0], m["noise"][0] = setpoint_N, 0.0
        m["before"][0] = ring[k % size] + self._current_A[k]
        self._machine.sense()
        y, angle = m["y"][0], self._angle_rad(k)
        if self._update_gains(angle, setpoint_N, y):
            self._machine.sense()
        self._columns[:, k] = y, m["effort"][0], angle
        self._flags[k] = SATURATED if m["excess"][0] else 0
        m["pidf"][:] = m["following"]
        ring[(k + self._delay + 1) % size] = m["drive"][0]
        m["after"][0] = ring[(k + 1) % size] + self._current_A[k]
        self._machine.move()
        if k + 1 < len(self._length_m):
            self._lengthen(k)
        return float(abs(y))

    def response(self, time_s: FloatArray, setpoint_N: FloatArray, ended: int | None) -> Response:
        """The columns of a complete trial, or until it diverged."""
        used = slice(ended)
        tension, effort, angle = self._columns[:, used]
        flags = self._flags[used]
        return Response(time_s[used], setpoint_N[used], tension, effort, angle, flags, ended)

    def _angle_rad(self, k: int) -> float:
        """Encoder reading of phi."""
        paid_out = (self._length_m[k] - self._length_m[0]) / self._reel.drum_radius_m
        step = 2.0 * math.pi / self._reel.encoder_counts
        turn = self._machine.memory["angle"][0] - self._scaled_rad - paid_out
        return float(step * math.floor(turn / step + 0.5))

    def _update_gains(self, angle_rad: float, setpoint_N: float, measurement_N: float) -> bool:
        """Updates the gains without a jump of the effort; returns whether they changed."""
        before, m = self._live.coefficients, self._machine.memory
        if not self._live.update(angle_rad, self._preload_N):
            return False
        after = self._live.coefficients
        state = pidf.PidfState(*m["pidf"])
        exchanged = pidf.bumpless_exchange(before, after, state, setpoint_N, measurement_N)
        m["pidf"][:] = np.array(exchanged).data
        m["coefficients"][:] = np.array(after).data
        return True

    def _lengthen(self, k: int) -> None:
        """Sets the length of the next sample."""
        if self._length_m[k + 1] == self._length_m[k]:
            return
        self._parameters[self._place] = self._length_m[k + 1]
        self._machine.set_parameters(self._parameters)
        theta = self._machine.memory["state"][THETA]
        scaled = theta * self._stretch[k + 1] / self._stretch[k]
        self._machine.memory["state"][THETA] = scaled
        self._scaled_rad += scaled - theta


def _live(reel: Reel, gains: GainSchedule | Gains, length_m: float, preload_N: float) -> LiveGains:
    settings = reel.controller
    if isinstance(gains, Gains):
        return LiveGains(pidf.coefficients(settings, gains), None)
    source = LengthSource(gains, settings, length_m, reel.drum_radius_m)
    return LiveGains(pidf.coefficients(settings, gains.gains(length_m, preload_N)), source)


def _stretch(reel: Reel, length_m: FloatArray, preload_N: float) -> FloatArray:
    """Flexibility 1/k of the cable at each length, m/N."""
    p = SimpleNamespace(**(vars(reel) | {"cable_length_m": length_m}))
    return np.asarray(1.0 / cable_stiffness_N_m(p, preload_N))


def _current_of_motion(reel: Reel, length_m: FloatArray) -> FloatArray:
    """(J s'' + b s')/R as a motor current, A, averaged from each sample to the next."""
    p = SimpleNamespace(**(vars(reel) | {"cable_length_m": length_m}))
    speed = np.diff(length_m, append=length_m[-1]) * reel.sampling_Hz
    at_samples = np.gradient(length_m) * reel.sampling_Hz
    acceleration = np.diff(at_samples, append=at_samples[-1]) * reel.sampling_Hz
    torque = reel.drum_inertia_kg_m2 * acceleration + viscous_friction_Nms(p) * speed
    return np.asarray(torque / (reel.drum_radius_m * reel.torque_constant_Nm_A))


def _check(reel: Reel, length_m: FloatArray, samples: int, *, open_loop: bool) -> None:
    if np.shape(length_m) != (samples,):
        raise InvalidInput(
            f"the cable length has shape {np.shape(length_m)} where the trial has {samples} "
            "samples"
        )
    if not (np.isfinite(length_m).all() and (length_m > 0.0).all()):
        raise InvalidInput("the cable length must be finite and above zero at every sample")
    if open_loop:
        raise InvalidInput("the profile is open-loop; give a closed-loop one, in which gains act")
    if reel.effects:
        names = ", ".join(type(effect).__name__ for effect in reel.effects)
        raise InvalidInput(
            f"a reel with {names} cannot be simulated while its cable's end moves: effects assume "
            "a fixed end; leave them out"
        )
