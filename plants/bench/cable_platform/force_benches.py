"""Benches for the felt force: two simulated reels, or rigs over the link."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.remote.security import OPEN, Security
from estune.remote.zenoh import RemoteRig, SetpointStream, connect
from estune.run.targets import is_endpoint, load
from estune.trial import RigDescription, Setpoint
from plants.bench.cable_platform.examples import bench
from plants.bench.cable_platform.mechanism import Mechanism, bench_carriage
from plants.bench.cable_platform.simulation import Simulation
from plants.bench.felt_force.force_procedure import ForceBench, ForceSample
from plants.models.reel import Reel

RATE_HZ = 200.0
"""Exchanges per second."""


class SimulatedForceBench:
    """A simulated bench, faster than real time; implements `ForceBench`. Reel 0 is tested."""

    def __init__(self, mechanism: Mechanism, seed: int = 0) -> None:
        self._simulation = Simulation(mechanism, seed=seed)
        self._samples = round(mechanism.sampling_Hz / RATE_HZ)
        self.period_s = self._samples / mechanism.sampling_Hz
        self._time_s = 0.0
        self._simulation.setpoints.in_tension[1] = False
        self._start_m = self._simulation.setpoints.wound_m[1]

    def use(self, gains: Gains) -> None:
        """Makes gains the live ones of the reel under test."""
        self._simulation.use(0, gains)

    def exchange(self, command_N: float, position_m: float) -> ForceSample:
        """Commands a tension and a position of the far end for one period."""
        simulation = self._simulation
        simulation.setpoints.tension_N[0] = command_N
        simulation.setpoints.wound_m[1] = self._start_m + position_m
        for _ in range(self._samples):
            simulation.sample()
        self._time_s += self.period_s
        return ForceSample(
            self._time_s,
            float(simulation.outside_N[0]),
            float(simulation.tension_N[0]),
            float(simulation.pose[0]),
        )


class ServedForceBench:
    """Rigs over the link, in real time; implements `ForceBench`.

    The force is the outside channel of the reel under test; without one, the tension of the reel
    that moves the far end. Without such a reel, the far end is moved by other means, and its
    position is the length that the reel under test has paid out.
    """

    def __init__(self, rig: RemoteRig, far: RemoteRig | None, drum_radius_m: float) -> None:
        self._rig, self._far, self._radius_m = rig, far, drum_radius_m
        self._stream = SetpointStream([rig, far] if far else [rig], RATE_HZ)
        self.period_s = 1.0 / RATE_HZ
        self._start_rad: tuple[float, ...] = ()
        self._offset_s = 0.0  # of this process's clock to the rig's

    def use(self, gains: Gains) -> None:
        """Makes gains the live ones of the reel under test."""
        self._rig.apply(gains)

    def exchange(self, command_N: float, position_m: float) -> ForceSample:
        """Commands a tension and a position of the far end for one period."""
        own = Setpoint(command_N)
        if not self._start_rad:  # the first exchange: where the drums are is not yet known
            hold = Setpoint(command_N)
            found = self._stream.exchange([own, hold] if self._far else [own])
            self._start_rad = tuple(each.angle_rad for each in found.feedback)
            self._offset_s = found.time_s - found.feedback[0].time_s
        setpoints = [own]
        if self._far is not None:
            angle = self._start_rad[1] + position_m / self._radius_m
            setpoints.append(Setpoint(command_N, angle))
        feedback = self._stream.exchange(setpoints).feedback
        outside = feedback[0].reference_N
        felt = feedback[-1].tension_N if outside is None else outside
        sign = -1.0 if self._far is None else 1.0
        turned = feedback[-1].angle_rad - self._start_rad[-1]
        # The rig's clock, by which it applies the setpoint and reads; the link delays the rest.
        time_s = feedback[0].time_s + self._offset_s
        return ForceSample(time_s, felt, feedback[0].tension_N, sign * self._radius_m * turned)


class TestedReel(NamedTuple):
    """A reel on its bench, and its description."""

    label: str
    bench: ForceBench
    about: RigDescription


@contextmanager
def open_benches(
    targets: Sequence[str], drum_radius_m: float, security: Security = OPEN, seed: int = 0
) -> Iterator[list[TestedReel]]:
    """The reels to be tested; two face to face test each other. Live gains are restored.

    Args:
        targets: Up to two endpoints, or models of reels; none is the reference reel.
        drum_radius_m: Drum radius of rigs at endpoints.
        security: Credentials for them.
        seed: Seed of simulated noise.

    Raises:
        InvalidInput: the targets are more than two, mixed, or no reels.
        RigError: a rig does not answer.
    """
    served = [is_endpoint(target) for target in targets]
    if len(targets) > 2 or len(set(served)) > 1:
        raise InvalidInput(
            f"{len(targets)} targets, {sum(served)} of them endpoints: give one or two endpoints, "
            "or one or two models of reels"
        )
    if not any(served):
        yield _simulated(targets, seed)
        return
    with ExitStack() as stack:
        rigs = [stack.enter_context(connect(target, security=security)) for target in targets]
        abouts = [rig.describe() for rig in rigs]
        for rig, about in zip(rigs, abouts, strict=True):
            stack.callback(_restore, rig, about)
        others = rigs[::-1] if len(rigs) > 1 else [None]
        yield [
            TestedReel(rig.name, ServedForceBench(rig, far, drum_radius_m), about)
            for rig, far, about in zip(rigs, others, abouts, strict=True)
        ]


def _restore(rig: RemoteRig, about: RigDescription) -> None:
    """Makes the gains live that were so before the test."""
    if rig.describe().gains != about.gains:
        rig.apply(about.gains)


def _simulated(targets: Sequence[str], seed: int) -> list[TestedReel]:
    models = [load(target) for target in targets] or list(bench()[0].reels[:1])
    for model in models:
        if not isinstance(model, Reel):
            raise InvalidInput(f"a bench holds reels, and {model!r} is none")
    pairs = [(models[0], models[-1]), (models[-1], models[0])][: len(models)]
    B = bench()[0].attenuation[0]
    return [
        TestedReel(
            label,
            SimulatedForceBench(bench_carriage(*pair, (B, B)), seed + n),
            pair[0].describe(label, None),
        )
        for n, (label, pair) in enumerate(zip("xy", pairs, strict=False))
    ]
