"""Reels that hold a body, each with a hybrid position and tension controller, by samples."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import Coefficients
from estune.core.quantities import FloatArray
from estune.reel import hybrid
from plants.bench.cable_platform.mechanism import PER_REEL, Mechanism
from plants.models.reel import SAFE_GAINS
from plants.simulation.buffers import Buffers

POSITION_GAINS = Gains(P=2000.0, I=6000.0, D=120.0, setpoint_filter_s=0.0)
"""Of the drum in m of cable; as in `experiments.paper.demonstrations.workspace_boundary`."""


@dataclass
class Setpoints:
    """Setpoints of all reels, shape (reels,).

    Attributes:
        wound_m: Lengths of cable wound in, m; used in position control.
        in_tension: Whether each reel controls its tension.
    """

    tension_N: FloatArray
    wound_m: FloatArray
    in_tension: FloatArray


class Simulation:
    """State of a mechanism and of its controllers.

    Attributes:
        tension_N: Readings of the gauges, N, shape (reels,).
        angle_rad: Readings of the encoders, rad.
        outside_N: Tensions outside the eyelets, N, by sensors with the noise of the gauges.
        force: Force of a user on each coordinate, N or N m.
    """

    def __init__(self, mechanism: Mechanism, gains: Sequence[Gains] = (), seed: int = 0) -> None:
        """Begins at rest at home, all tensions at the reels' own.

        Args:
            mechanism: Reels and body.
            gains: Tension gains of each reel; cautious ones by default.
            seed: Seed of the gauges' noise.
        """
        self.mechanism = mechanism
        reels = mechanism.reels
        self._radius_m = np.array([reel.drum_radius_m for reel in reels])
        self._noise_N = np.array([reel.gauge_noise_N for reel in reels])
        self._step_rad = 2.0 * np.pi / np.array([reel.encoder_counts for reel in reels])
        self._random = np.random.default_rng(seed)
        tension = np.array([reel.tension_N for reel in reels])
        state = mechanism.at_rest(tension)
        self._bind(mechanism, state)
        self._delayed_N = self.effort_N = tension
        self._position = _coefficients(mechanism, [POSITION_GAINS] * len(reels))
        self._gains = list(gains) or [SAFE_GAINS] * len(reels)
        self._tension = _coefficients(mechanism, self._gains)
        self.force = np.zeros(len(mechanism.home))
        self._observe(tension, state[: PER_REEL * len(reels) : PER_REEL], tension)
        wound = self._radius_m * self.angle_rad
        self.setpoints = Setpoints(tension.copy(), wound.copy(), np.ones(len(reels), np.bool_))
        self._control = hybrid.HybridState(
            pidf.state_at_rest(wound, tension),
            pidf.state_at_rest(tension, tension),
            self.setpoints.in_tension.copy(),
        )

    @property
    def pose(self) -> FloatArray:
        """Coordinates q of the body."""
        start = PER_REEL * len(self.mechanism.reels)
        return self._state[start : start + len(self.mechanism.home)].copy()

    @property
    def gains(self) -> list[Gains]:
        """Tension gains of each reel."""
        return list(self._gains)

    def use(self, reel: int, gains: Gains) -> None:
        """Changes the tension gains of a reel, without a jump of its effort."""
        self._gains[reel] = gains
        before, self._tension = self._tension, _coefficients(self.mechanism, self._gains)
        exchanged = pidf.bumpless_exchange(
            *(before, self._tension, self._control.tension),
            *(self.setpoints.tension_N, self.tension_N),
        )
        self._control = self._control._replace(tension=exchanged)

    def sample(self) -> None:
        """Runs all controllers once and the mechanism for one sample."""
        wanted = self.setpoints
        signals = hybrid.HybridSignals(
            *(wanted.wound_m, self._radius_m * self.angle_rad, wanted.tension_N, self.tension_N)
        )
        both = hybrid.HybridCoefficients(self._position, self._tension)
        self._control, effort = hybrid.step(both, self._control, signals, wanted.in_tension.copy())
        memory = self._memory
        memory["effort"][:], memory["force"][:] = self._delayed_N, self.force
        self._advance()
        self._delayed_N = self.effort_N = effort
        self._state[:] = memory["following"]
        self._observe(memory["reading"], memory["angle"], memory["outside"])

    def _bind(self, mechanism: Mechanism, state: FloatArray) -> None:
        """Binds the mechanism to memory of this simulation.

        The force test of `tests/test_force_bench.py` takes 2.2 s of CPU so, and 5.1 s with
        arguments of the function.
        """
        reels = dict.fromkeys(("effort", "reading", "angle", "outside"), len(mechanism.reels))
        states = dict.fromkeys(("state", "following"), state.size)
        self._buffers = Buffers({**states, **reels, "force": len(mechanism.home)})
        names = "state effort force", "following reading angle outside"
        self._advance = self._buffers.bind(mechanism.advance, *names)
        self._memory: dict[str, FloatArray] = {
            name: np.frombuffer(part) for name, part in self._buffers.memory.items()
        }
        self._state = self._memory["state"]
        self._state[:] = state

    def _observe(self, reading: FloatArray, angle: FloatArray, outside: FloatArray) -> None:
        noise = self._noise_N * self._random.standard_normal((2, reading.size))
        self.tension_N, self.outside_N = reading + noise[0], outside + noise[1]
        self.angle_rad = np.floor(angle / self._step_rad + 0.5) * self._step_rad


def _coefficients(mechanism: Mechanism, gains: Sequence[Gains]) -> Coefficients:
    """Difference equation of all reels at once, its numbers with shape (reels,)."""
    each = [
        pidf.coefficients(reel.controller, own)
        for reel, own in zip(mechanism.reels, gains, strict=True)
    ]
    return Coefficients(*(np.array(column) for column in zip(*each, strict=True)))
