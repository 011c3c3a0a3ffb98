"""Ordinary service: setpoints of seven kinds, loads and noise of several colours, the record."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.prediction import StepTrial
from estune.recordings.loop_log import LoopLog
from estune.service_records.advice import PERIOD, multisine
from plants.simulation.batch import simulate_drive
from plants.simulation.plant import Plant, TrialSetpoint

DITHER_HZ_T = (0.2, 6.0)
"""Band of the dither, in periods per settling time."""

BOUND = 1e3
"""Measurement at which a record ends, in steps."""

Random = np.random.Generator


class Service(NamedTuple):
    """What a loop does while it is recorded.

    Attributes:
        kind: Name in `SETPOINTS`.
        settling_times: Length of the record.
        load: Standard deviation of the load at the plant's input, as a share of the step.
        correlation: Correlation time of the load, in settling times.
        noise: Standard deviation of the measurement noise, as a share of the step.
    """

    kind: str
    settling_times: float = 80.0
    load: float = 0.01
    correlation: float = 4.0
    noise: float = 0.004


class ServiceRecord(NamedTuple):
    """Signals of a record, deviations from the operating point, shape (samples,) each."""

    setpoint: FloatArray
    measurement: FloatArray
    effort: FloatArray

    def log(self, sampling_Hz: float, gains: Gains, name: str = "record") -> LoopLog:
        """The record as a log of a loop with these gains."""
        time_s = np.arange(self.setpoint.size) / sampling_Hz
        return LoopLog(name, sampling_Hz, ({"time": time_s, **self._asdict()},), gains, {}, {}, ())


def still(_random: Random, samples: int, _T: float) -> FloatArray:
    """A constant setpoint."""
    return np.zeros(samples)


def ramps(random: Random, samples: int, T: float) -> FloatArray:
    """Ramps of up to half a step within 6 to 15 settling times."""
    times, values = [0.0], [0.0]
    while times[-1] < samples:
        times.append(times[-1] + T * random.uniform(6.0, 15.0))
        values.append(random.uniform(-0.5, 0.5))
    return np.interp(np.arange(samples), times, values)


def small_steps(random: Random, samples: int, T: float) -> FloatArray:
    """Steps of 2 to 5 % of the trial's every 4 to 10 settling times."""
    return _steps(random, samples, T, (4.0, 10.0), lambda: random.uniform(0.02, 0.05))


def dither(share: float) -> Callable[[Random, int, float], FloatArray]:
    """A constant setpoint with a multisine of some share of the step, rms."""

    def of(random: Random, samples: int, T: float) -> FloatArray:
        k = np.arange(samples)
        low, high = DITHER_HZ_T[0] / T, min(DITHER_HZ_T[1] / T, 0.4)
        frequencies = np.geomspace(low, high, 24)
        phases = random.uniform(0.0, 2.0 * math.pi, frequencies.size)
        waves = np.sin(2.0 * math.pi * frequencies[:, np.newaxis] * k + phases[:, np.newaxis])
        total = waves.sum(axis=0)
        return np.asarray(share * total / np.sqrt(np.mean(total**2)))

    return of


def advised(share: float) -> Callable[[Random, int, float], FloatArray]:
    """A constant setpoint with the multisine that `suggest` advises and the daemon adds."""

    def of(_random: Random, samples: int, T: float) -> FloatArray:
        profile = multisine(0.0, share, round(PERIOD * T) / PERIOD, 1.0)
        return np.resize(profile.setpoint(1.0), samples)

    return of


def busy(random: Random, samples: int, T: float) -> FloatArray:
    """Steps, ramps and sines of up to 40 % of the step, one after the other."""
    setpoint, at, value = np.zeros(samples), 0, 0.0
    while at < samples:
        length = int(T * random.uniform(3.0, 8.0))
        here = np.arange(min(length, samples - at))
        target = random.uniform(-0.4, 0.4)
        kind = random.integers(3)
        if kind == 0:
            wanted = np.full(here.size, target)
        elif kind == 1:
            wanted = value + (target - value) * here / length
        else:
            period = T * random.uniform(0.7, 3.0)
            wanted = value + 0.2 * target * np.sin(2.0 * math.pi * here / period)
        setpoint[at : at + here.size] = wanted
        value, at = float(wanted[-1]), at + here.size
    return setpoint


def production(random: Random, samples: int, T: float) -> FloatArray:
    """Steps of 10 to 30 % every 10 to 30 settling times."""
    return _steps(random, samples, T, (10.0, 30.0), lambda: random.uniform(0.1, 0.3))


SETPOINTS: dict[str, Callable[[Random, int, float], FloatArray]] = {
    "still": still,
    "ramps": ramps,
    "small steps": small_steps,
    "dither 1 %": dither(0.01),
    "advised 1 %": advised(0.01),
    "busy": busy,
    "production": production,
}
"""Setpoints in units of the step, from random numbers, samples and samples of a settling time."""


def serve(
    plant: Plant, trial: StepTrial, gains: Gains, service: Service, seed: int
) -> ServiceRecord:
    """Simulated record of a plant in service, begun in motion.

    Args:
        plant: The plant.
        trial: Its step trial, which sets the scale of time and size.
        gains: The gains in use.
        service: What it does.
        seed: Of setpoint, load and noise.
    """
    random = np.random.default_rng([seed, *service.kind.encode()])
    rate, step = trial.controller.sampling_Hz, trial.step.size
    T = trial.cost.settling_time_s * rate
    begun = int(10.0 * T)
    samples = begun + int(service.settling_times * T)
    middle = trial.preload + 0.5 * step
    setpoint = middle + step * SETPOINTS[service.kind](random, samples, T)
    load = service.load * step * _coloured(random, samples, service.correlation * T)
    noise = service.noise * abs(step) * random.standard_normal(samples)
    time = np.arange(samples) / rate
    drive = TrialSetpoint(time, setpoint, middle, open_loop=False, load_N=load)
    r = simulate_drive(plant, gains, drive, noise, abs(middle) + BOUND * abs(step))
    return ServiceRecord(r.setpoint_N[begun:], r.tension_N[begun:], r.effort_N[begun:])


def _steps(
    random: Random,
    samples: int,
    T: float,
    every: tuple[float, float],
    size: Callable[[], float],
) -> FloatArray:
    setpoint, at, level = np.zeros(samples), 0, 0.0
    while at < samples:
        length = int(T * random.uniform(*every))
        setpoint[at : at + length] = level
        # Up and down in turn keeps the setpoint about the operating point.
        level = size() * (-1.0 if level > 0.0 else 1.0)
        at += length
    return setpoint


def _coloured(random: Random, samples: int, correlation: float) -> FloatArray:
    """Noise of standard deviation one with an exponential correlation."""
    pole = math.exp(-1.0 / correlation)
    white = math.sqrt(1.0 - pole**2) * random.standard_normal(samples)
    white[0] = random.standard_normal()
    return lfilter([1.0], [1.0, -pole], white)
