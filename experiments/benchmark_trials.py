"""How long does a simulated trial take beside hand-written C?

Command: `python -m experiments.benchmark_trials`.
Target: at most 1.5 times the C, to 1e-9 N; no effect takes more than five times the bare reel.

Calls that are compared are timed alternately; times are medians. The trial is the reference reel
with gauge mode, Coulomb friction, slack, current limit and dead time, 632 samples. The same
equations are hand-written in reference_trial.c.
"""

import ctypes
import gc
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import plants
from estune.core import pidf
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.support import c_compiler
from experiments.results import at_most, command_line, print_results
from plants.effects import EFFECTS
from plants.models.reel import Reel
from plants.simulation.batch import divergence_limit_N
from plants.simulation.noise import NoiseSource
from plants.simulation.trial_loop import Batch, CasadiLoop, loop_functions, trial_loop

GAINS = Gains(P=1.2, I=50.0, D=0.02, setpoint_filter_s=0.004)
REEL = plants.reference_reel()
FRICTION = plants.CoulombFriction(torque_Nm=0.02)

TARGETS = {
    "times_hand_written_C": 1.5,
    "difference_from_C_N": 1e-9,  # the largest difference
    "difference_from_C_when_slack_N": 1e-9,
    "slowest_effect_times_bare": 5.0,
}
"""Upper limit of each figure."""


class Timed(NamedTuple):
    """A call to be timed, in `blocks` blocks of `calls` calls in each round."""

    call: Callable[[], Any]
    blocks: int = 1
    calls: int = 1


def alternate(timed: dict[str, Timed], rounds: int) -> dict[str, float]:
    """Median time of each call, us.

    The calls alternate, so that load affects all alike, and the blocks are short, so that the
    median block is not interrupted by other programs.
    """
    times: dict[str, list[float]] = {name: [] for name in timed}
    for one in timed.values():
        one.call()
    gc.disable()
    for _ in range(rounds):
        for name, (call, blocks, calls) in timed.items():
            for _ in range(blocks):
                began = time.perf_counter()
                for _ in range(calls):
                    call()
                times[name].append((time.perf_counter() - began) / calls * 1e6)
    gc.enable()
    return {name: statistics.median(values) for name, values in times.items()}


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


def reference_batch(reel: Reel, noise: FloatArray) -> Batch:
    """The reference trial as a batch of one."""
    return Batch(
        reel.parameter_values,
        np.array([pidf.coefficients(reel.controller, GAINS)]),
        reel.profile.preload_N,
        reel.profile.setpoint(reel.sampling_Hz),
        noise[np.newaxis],
        delay=1,
        bound_N=divergence_limit_N(reel.profile),
    )


def measure_trial(rounds: int) -> dict[str, float]:
    """The trial against hand-written C and the virtual machine."""
    reel = REEL + FRICTION
    noise = NoiseSource(0).draw(0, 632, reel.gauge_noise_N)
    batch = reference_batch(reel, noise)
    library, compiled = reference_library(), trial_loop(reel.structure)
    virtual = CasadiLoop(loop_functions(reel.structure.equations()))
    by_hand = hand_written(library, batch)
    # A setpoint that makes the cable slack and taut again.
    slack = batch._replace(setpoint_N=np.where(batch.setpoint_N > batch.preload_N, -20.0, 15.0))
    ours = compiled.run(batch).tension_N[0]
    figures = {
        "difference_from_C_N": largest(ours - by_hand()[0]),
        "difference_from_C_when_slack_N": largest(
            compiled.run(slack).tension_N[0] - hand_written(library, slack)()[0]
        ),
        "difference_from_virtual_machine_N": largest(ours - virtual.run(batch).tension_N[0]),
    }
    figures |= alternate(
        {
            "hand_written_C_us": Timed(by_hand, 20, 20),
            "compiled_us": Timed(lambda: compiled.run(batch), 20, 20),
            "simulate_us": Timed(lambda: plants.simulate(reel, GAINS, noise_N=noise), 20, 20),
            "virtual_machine_us": Timed(lambda: virtual.run(batch), 5),
        },
        rounds,
    )
    figures["times_hand_written_C"] = figures["compiled_us"] / figures["hand_written_C_us"]
    return figures


def largest(difference: FloatArray) -> float:
    """Largest absolute value."""
    return float(np.abs(difference).max())


def measure_effects(rounds: int) -> dict[str, float]:
    """A trial with each effect of the package, and with all, relative to the bare reel."""
    reels = {"bare": REEL, "all_effects": REEL}
    for name, effect in EFFECTS.items():
        reels[name], reels["all_effects"] = REEL + effect(), reels["all_effects"] + effect()
    times = alternate(
        {name: Timed(partial(plants.simulate, reel, GAINS), 10) for name, reel in reels.items()},
        rounds,
    )
    ratios = {f"{name}_times_bare": time / times["bare"] for name, time in times.items()}
    slowest = max(ratios[f"{name}_times_bare"] for name in EFFECTS)
    return ratios | {"slowest_effect_times_bare": slowest}


def main() -> int:
    """Measures and prints; exit code 1 if a target is missed."""
    options = command_line(__doc__, quick="fewer repeats").parse_args()
    rounds = 3 if options.quick else 15
    figures = measure_trial(rounds) | measure_effects(rounds)
    targets = {name: at_most(figures[name], limit) for name, limit in TARGETS.items()}
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
