"""How long does a simulated trial take beside hand-written C and python-control?

Command: `python -m experiments.benchmark_trials`.
Target: at most 1.5 times the C, to 1e-9 N; 100 times faster than python-control; 1.8 times on two
cores.

One run on one core, except for the batch; calls that are compared are timed alternately. Times are
medians, for the batch those of the fastest round. The nonlinear trial is the reference reel with
gauge mode, Coulomb friction, slack, current limit and dead time, 632 samples. The same equations
are hand-written in reference_trial.c, and below as a discrete-time NonlinearIOSystem of
python-control. The linear trial is the reel without its nonlinear parts; its dead time in
python-control is a Pade approximation.
"""

import gc
import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import control
import numpy as np

import plants
from estune import interop
from estune.core import pidf
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.run.planning import make_plan
from estune.run.session import after_trial, new_session, next_request
from estune.trial.loop_records import loop_signals
from estune.trial.scoring import cost_of
from estune.tuners import create_tuner
from estune.tuners.observation import Observation
from estune.tuners.search_space import SearchSpace
from experiments.reference_trial import (
    hand_written,
    nonlinear_start,
    nonlinear_system,
    reference_library,
)
from experiments.results import Target, at_least, at_most, command_line, print_results
from plants.effects import EFFECTS
from plants.models.reel import Reel
from plants.simulation.batch import divergence_limit_N
from plants.simulation.noise import NoiseSource
from plants.simulation.plant import drive_of
from plants.simulation.trial_loop import Batch, CasadiLoop, loop_functions, trial_loop

GAINS = Gains(P=1.2, I=50.0, D=0.02, setpoint_filter_s=0.004)
REEL = plants.reference_reel()
FRICTION = plants.CoulombFriction(torque_Nm=0.02)

ENGINES = ("least_squares_gradient", "phase_compensated", "otis", "killingsworth")
SEARCHED = SearchSpace.around(Gains(0.4, 12.0, 0.01, 0.03))

TARGETS: dict[str, tuple[float, Callable[[float, float], Target]]] = {
    "times_hand_written_C": (1.5, at_most),
    "difference_from_C_N": (1e-9, at_most),  # the largest difference
    "difference_from_C_when_slack_N": (1e-9, at_most),
    "faster_than_step_response": (100.0, at_least),  # the linear trial
    "faster_than_input_output_response": (300.0, at_least),  # the nonlinear trial
    "batch_speedup_two_cores": (1.8, at_least),
    "memory_growth_MB": (2.0, at_most),  # over further batches
    "slowest_effect_times_bare": (5.0, at_most),
    "slowest_engine_us": (50.0, at_most),  # gradient or extremum seeking, ask and tell
    "ask_and_tell_safe_bayesian_us": (2500.0, at_most),
    "ask_and_tell_model_based_us": (30_000.0, at_most),
}
"""Limit of each figure, and its kind."""


class Timed(NamedTuple):
    """A call to be timed, in `blocks` blocks of `calls` calls in each round."""

    call: Callable[[], Any]
    blocks: int = 1
    calls: int = 1


def alternate(
    timed: dict[str, Timed], rounds: int, of: Callable[[list[float]], float] = statistics.median
) -> dict[str, float]:
    """Median time of each call, us, or another statistic of its times.

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
    return {name: of(values) for name, values in times.items()}


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


def measure_nonlinear(rounds: int) -> dict[str, float]:
    """The nonlinear trial against hand-written C, the virtual machine and python-control."""
    reel = REEL + FRICTION
    noise = NoiseSource(0).draw(0, 632, reel.gauge_noise_N)
    batch = reference_batch(reel, noise)
    library, compiled = reference_library(), trial_loop(reel.structure)
    virtual = CasadiLoop(loop_functions(reel.structure.equations()))
    by_hand = hand_written(library, batch)
    system, start = nonlinear_system(reel, GAINS, FRICTION.torque_Nm), nonlinear_start(reel)
    t, inputs = np.arange(632) / reel.sampling_Hz, np.vstack([batch.setpoint_N, noise])

    def peer() -> Any:
        return control.input_output_response(system, t, inputs, start).outputs

    # A setpoint that makes the cable slack and taut again.
    slack = batch._replace(setpoint_N=np.where(batch.setpoint_N > batch.preload_N, -20.0, 15.0))
    ours = compiled.run(batch).tension_N[0]
    figures = {
        "difference_from_C_N": largest(ours - by_hand()[0]),
        "difference_from_C_when_slack_N": largest(
            compiled.run(slack).tension_N[0] - hand_written(library, slack)()[0]
        ),
        "difference_from_virtual_machine_N": largest(ours - virtual.run(batch).tension_N[0]),
        "difference_from_python_control_N": largest(ours - peer()),
    }
    figures |= alternate(
        {
            "hand_written_C_us": Timed(by_hand, 20, 20),
            "compiled_us": Timed(lambda: compiled.run(batch), 20, 20),
            "simulate_us": Timed(lambda: plants.simulate(reel, GAINS, noise_N=noise), 20, 20),
            "virtual_machine_us": Timed(lambda: virtual.run(batch), 5),
            "input_output_response_us": Timed(peer),
        },
        rounds,
    )
    compiled_us = figures["compiled_us"]
    figures["times_hand_written_C"] = compiled_us / figures["hand_written_C_us"]
    figures["faster_than_input_output_response"] = (
        figures["input_output_response_us"] / compiled_us
    )
    return figures


def largest(difference: FloatArray) -> float:
    """Largest absolute value."""
    return float(np.abs(difference).max())


def measure_linear(rounds: int) -> dict[str, float]:
    """The linear trial against python-control's step response; closing the loop is timed apart."""
    plant = plants.linear_plant(
        control.ss(*linear_matrices(REEL)),
        REEL.dead_time_s,
        REEL.sampling_Hz,
        derivative_filter_s=REEL.derivative_filter_s,
        profile=REEL.profile,
    )
    row = np.array([pidf.coefficients(plant.controller, GAINS)])
    loop, limit = linear_loop(), divergence_limit_N(plant.profile)
    drive = drive_of(plant.profile, REEL.sampling_Hz)
    t = np.arange(632 - plant.profile.step_index(REEL.sampling_Hz)) / REEL.sampling_Hz
    figures = alternate(
        {
            "linear_compiled_us": Timed(lambda: plant.respond(row, drive, None, limit), 20, 20),
            "step_response_us": Timed(lambda: control.step_response(loop, t)),
            "closing_the_loop_us": Timed(linear_loop),
        },
        rounds,
    )
    figures["faster_than_step_response"] = (
        figures["step_response_us"] / figures["linear_compiled_us"]
    )
    return figures


def linear_matrices(reel: Reel) -> tuple[Any, Any, Any, float]:
    """The reel's linear model in the form python-control takes."""
    model = reel.linear_model()
    return np.array(model.A), np.array(model.B)[:, None], np.array(model.C)[None], model.E


def linear_loop() -> Any:
    """T = F G C_r/(1 + G C_y), (34), in python-control."""
    F, C_r, C_y = interop.to_control(GAINS, REEL.controller)
    late = control.tf(*control.pade(REEL.dead_time_s, 1))
    plant = control.ss(*linear_matrices(REEL)) * control.ss(late)
    return control.feedback(plant, control.ss(C_y)) * control.ss(C_r * F)


def measure_batch(trials: int, rounds: int) -> dict[str, float]:
    """Batches on one and two cores, and the growth of memory."""
    reel, cost = REEL + FRICTION, StepCost(0.13, move_weight=0.2)
    spread = np.random.default_rng(0).normal(0.0, 0.2, (trials, 4))
    table = np.exp(spread) * GAINS.as_tuple()

    def run(workers: int) -> FloatArray:
        return plants.batch_costs(reel, table, None, cost, workers=workers)

    if not np.array_equal(run(1), run(2), equal_nan=True):
        raise SystemExit("the batch gives other costs on two cores than on one")
    # The minimum: other load slows two threads on two cores more than one thread.
    both = {"one": Timed(lambda: run(1)), "two": Timed(lambda: run(2))}
    times, work = alternate(both, rounds, of=min), {}
    for workers in (1, 2):
        began = time.process_time()
        run(workers)
        work[workers] = time.process_time() - began
    gc.collect()
    for _ in range(20):  # creates every thread's memory pool
        run(2)
    before = memory_MB()
    for _ in range(10):
        run(2)
    after = memory_MB()
    return {
        "batch_trials": float(trials),
        "batch_one_core_s": times["one"] / 1e6,
        "batch_two_cores_s": times["two"] / 1e6,
        "batch_speedup_two_cores": times["one"] / times["two"],
        "batch_work_two_cores_over_one": work[2] / work[1],
        "memory_before_MB": before,
        "memory_after_MB": after,
        "memory_growth_MB": after - before,
    }


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


def memory_MB() -> float:
    """Resident memory of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure_tuners(trials: int) -> dict[str, float]:
    """Time of ask and tell.

    The engines cost microseconds. The Bayesian search pays milliseconds to need fewer trials than
    these, and the search by the records tens of milliseconds to need fewer than that one.
    """
    figures: dict[str, float] = {}
    for name in ENGINES:
        asked = asking(create_tuner(name, SEARCHED))
        figures[f"ask_and_tell_{name}_us"] = median_block(asked, trials)
    figures["slowest_engine_us"] = max(figures.values())
    bayesian = create_tuner("safe_bayesian", SEARCHED)
    figures["ask_and_tell_safe_bayesian_us"] = median_block(asking(bayesian), trials // 5)
    figures["ask_and_tell_model_based_us"] = statistics.median(
        model_based_us(seed) for seed in range(5)
    )
    return figures


def model_based_us(seed: int) -> float:
    """Time of the search for each trial of a tuning by the records, to its own stop."""
    rig = REEL.rig(seed=seed)
    about = rig.describe()
    plan = make_plan(
        about, "timed", tuner="model_based", start=None, bounds=None, step=None, cost=None
    )
    session, spent = new_session(plan), 0.0
    while not session.search_end and (request := next_request(session)) is not None:
        record = rig.run(request)
        cost = cost_of(record, plan.step, plan.cost, about.newtons_per_ampere)
        began = time.process_time()
        signals = loop_signals(record, plan.step, about).record
        session = after_trial(session, record.outcome, cost, record=signals)
        spent += time.process_time() - began
    return spent / session.number * 1e6


def median_block(trials: Iterator[None], count: int) -> float:
    """Time of a trial, us: the median over blocks of 5 consecutive trials."""
    times = []
    gc.disable()
    for _ in range(count // 5):
        began = time.perf_counter()
        for _ in range(5):
            next(trials)
        times.append((time.perf_counter() - began) / 5 * 1e6)
    gc.enable()
    return statistics.median(times)


def asking(tuner: Any) -> Iterator[None]:
    """Tell and ask, trial after trial, with an artificial cost."""
    state = tuner.start()
    for number in itertools.count():
        state = tuner.tell(state, Observation(1.0 + 0.1 * math.sin(number)))
        tuner.ask(state)
        yield


def main() -> int:
    """Measures and prints; exit code 1 if a target is missed."""
    options = command_line(__doc__, quick="fewer repeats and smaller batches").parse_args()
    rounds, batch, trials = (3, 2000, 500) if options.quick else (15, 10_000, 5000)
    figures = measure_nonlinear(rounds) | measure_linear(rounds)
    figures |= measure_batch(batch, rounds) | measure_effects(rounds)
    figures |= measure_tuners(trials)
    targets = {name: kind(figures[name], limit) for name, (limit, kind) in TARGETS.items()}
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
