"""A reel whose far cable end moves in the midst of a trial, under scheduled or fixed gains.

The end moves outward by s(t) = L(t) - L(0). With the drum's turn phi, counted as it winds in, the
cable is stretched by theta = phi + s/R turns, and the drum obeys, in terms of theta,

    J theta'' + b theta' + R T = Kt i + (J s'' + b s')/R,    b = b_0 + b_L L,    T = k(L) R theta,

the equations of `plants.models.reel_equations` with one more torque, and with k and b of the length at
each sample. What is paid out is strained as the deployed cable is, so that a change of length by
itself does not change the tension, T' = k(L) (R phi' + s'): theta is scaled by k before over k
after.
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
from plants.simulation.batch import Response, bound
from plants.simulation.plant import drive_of
from plants.simulation.trial_loop import VirtualMachine, loop_functions


def simulate_moving(
    reel: Reel,
    gains: GainSchedule | Gains,
    length_m: FloatArray,
    profile: AnyProfile | None = None,
    *,
    noise_N: FloatArray | None = None,
) -> Response:
    """Runs one closed-loop trial in which the cable's length changes.

    Scheduled gains follow the length as those of a rig do (`estune.hardware.live_gains`): by the
    drum's angle, at the profile's preload, without a jump of the effort.

    Args:
        reel: The reel; its own length plays no part.
        gains: A schedule, or gains that stay.
        length_m: Deployed length at each sample, m, shape (samples,); smooth, for its second
            derivative is a force.
        profile: The setpoint; None is the reel's own step.
        noise_N: What the measurement noise adds, N, shape (samples,); None is no noise.

    Returns:
        The trial; its angle is the drum's, phi.

    Raises:
        InvalidInput: length or noise have another shape than the trial, a length is not above
            zero, the profile is open-loop, or the reel has effects, which are written for a cable
            whose end stays.
        PlantError: the reel cannot be simulated.
    """
    profile = profile or reel.profile
    drive = drive_of(profile, reel.sampling_Hz)
    samples = len(drive.time_s)
    noise = np.zeros(samples) if noise_N is None else noise_N
    _check(reel, length_m, noise, samples, open_loop=drive.open_loop)
    live = _live(reel, gains, float(length_m[0]), drive.preload_N)
    trial = _Trial(reel, length_m, drive.preload_N, live)
    limit = bound(profile)
    for k, (setpoint, added) in enumerate(
        zip(drive.setpoint_N.tolist(), noise.tolist(), strict=True)
    ):
        if not trial.sample(k, setpoint, added) <= limit:
            return trial.response(drive.time_s, drive.setpoint_N, k)
    return trial.response(drive.time_s, drive.setpoint_N, None)


class _Trial:
    """The trial under way."""

    def __init__(
        self, reel: Reel, length_m: FloatArray, preload_N: float, live: LiveGains
    ) -> None:
        shortest = replace(reel, cable_length_m=float(length_m.min()))
        # The encoder is on the drum: what it reads is rounded once phi is known.
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
        self._scaled_rad = 0.0  # what scaling has added to theta: the drum did not turn by it
        self._delay = reel.delay_samples
        self._ring = [self._machine.memory["drive"][0]] * (self._delay + 2)
        self._columns = np.zeros((3, len(length_m)))
        self._flags = np.zeros(len(length_m), np.uint8)

    def sample(self, k: int, setpoint_N: float, noise_N: float) -> float:
        """One sample; the size of the measurement."""
        m, ring, size = self._machine.memory, self._ring, len(self._ring)
        m["setpoint"][0], m["noise"][0] = setpoint_N, noise_N
        m["before"][0] = ring[k % size] + self._current_A[k]
        self._machine.sense()
        y, angle = m["y"][0], self._angle_rad(k)
        if self._follow(angle, setpoint_N, y):
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
        """What was measured, to its end or until it diverged."""
        kept = slice(ended)
        tension, effort, angle = self._columns[:, kept]
        flags = self._flags[kept]
        return Response(time_s[kept], setpoint_N[kept], tension, effort, angle, flags, ended)

    def _angle_rad(self, k: int) -> float:
        """Phi as the encoder reads it."""
        paid_out = (self._length_m[k] - self._length_m[0]) / self._reel.drum_radius_m
        step = 2.0 * math.pi / self._reel.encoder_counts
        turn = self._machine.memory["angle"][0] - self._scaled_rad - paid_out
        return float(step * math.floor(turn / step + 0.5))

    def _follow(self, angle_rad: float, setpoint_N: float, measurement_N: float) -> bool:
        """Whether the gains have become others; the controller then goes on without a jump."""
        before, m = self._live.coefficients, self._machine.memory
        if not self._live.update(angle_rad, self._preload_N):
            return False
        after = self._live.coefficients
        state = pidf.PidfState(*m["pidf"])
        exchanged = pidf.exchanged(before, after, state, setpoint_N, measurement_N)
        m["pidf"][:] = np.array(exchanged).data
        m["coefficients"][:] = np.array(after).data
        return True

    def _lengthen(self, k: int) -> None:
        """Takes the length of the next sample."""
        if self._length_m[k + 1] == self._length_m[k]:
            return
        self._parameters[self._place] = self._length_m[k + 1]
        self._machine.amend(self._parameters)
        theta = self._machine.memory["state"][THETA]
        scaled = theta * self._stretch[k + 1] / self._stretch[k]
        self._machine.memory["state"][THETA] = scaled
        self._scaled_rad += scaled - theta


def _live(reel: Reel, gains: GainSchedule | Gains, length_m: float, preload_N: float) -> LiveGains:
    settings = reel.controller
    if isinstance(gains, Gains):
        return LiveGains(pidf.coefficients(settings, gains), None)
    following = LengthSource(gains, settings, length_m, reel.drum_radius_m)
    return LiveGains(pidf.coefficients(settings, gains.gains(length_m, preload_N)), following)


def _stretch(reel: Reel, length_m: FloatArray, preload_N: float) -> FloatArray:
    """The cable's flexibility 1/k at each length, m/N."""
    p = SimpleNamespace(**(vars(reel) | {"cable_length_m": length_m}))
    return np.asarray(1.0 / cable_stiffness_N_m(p, preload_N))


def _current_of_motion(reel: Reel, length_m: FloatArray) -> FloatArray:
    """(J s'' + b s')/R as a motor current, A, its mean from each sample to the next."""
    p = SimpleNamespace(**(vars(reel) | {"cable_length_m": length_m}))
    speed = np.diff(length_m, append=length_m[-1]) * reel.sampling_Hz
    at_samples = np.gradient(length_m) * reel.sampling_Hz
    acceleration = np.diff(at_samples, append=at_samples[-1]) * reel.sampling_Hz
    torque = reel.drum_inertia_kg_m2 * acceleration + viscous_friction_Nms(p) * speed
    return np.asarray(torque / (reel.drum_radius_m * reel.torque_constant_Nm_A))


def _check(
    reel: Reel, length_m: FloatArray, noise_N: FloatArray, samples: int, *, open_loop: bool
) -> None:
    for what, column in (("cable length", length_m), ("noise", noise_N)):
        if np.shape(column) != (samples,):
            raise InvalidInput(
                f"the {what} has shape {np.shape(column)} where the trial has {samples} samples"
            )
    if not (np.isfinite(length_m).all() and (length_m > 0.0).all()):
        raise InvalidInput("the cable length must be finite and above zero at every sample")
    if open_loop:
        raise InvalidInput("the profile is open-loop; gains only act in a closed one")
    if reel.effects:
        names = ", ".join(type(effect).__name__ for effect in reel.effects)
        raise InvalidInput(
            f"a reel with {names} cannot be simulated while its cable's end moves: effects see "
            "the turn of a drum whose cable's end stays; leave them out"
        )
