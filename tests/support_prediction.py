"""Records of a reel whose numbers are known, and predictions of them."""

from dataclasses import replace

import numpy as np

import plants
from estune.core.gains import Gains
from estune.trial.profiles import MultisineProfile, StepProfile, TriangleProfile
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import Noise, NoiseFloor

GAINS = Gains(0.4, 12.0, 0.01, 0.03)
REEL = plants.reference_reel(encoder_counts=1e12)
LINES = MultisineProfile(15.0, 4.0, 1.0, 1, 60, 2.2, start_s=0.1, lines="odd", loop="open")
PROFILES = (
    replace(LINES, duration_s=1.2),
    StepProfile(15.0, 8.0, 0.1, 0.8),
    TriangleProfile(15.0, 6.0, 0.5, 0.7, start_s=0.1, loop="open"),
)


def measure(model, profile, *, noise_N=0.0, seed=0, name="a"):
    """Simulated record of a model, at its own length and rate."""
    rate = model.controller.sampling_Hz
    noise = noise_N * np.random.default_rng(seed).normal(size=profile.samples(rate))
    response = plants.simulate(model, GAINS, profile, noise_N=noise)
    return MeasuredRecord(
        name=name,
        rig="rig",
        sampling_Hz=rate,
        cable_length_m=getattr(model, "cable_length_m", None),
        preload_N=profile.preload_N,
        loop=profile.loop,
        profile=profile.kind,
        gains=GAINS,
        time_s=response.time_s,
        setpoint_N=response.setpoint_N,
        tension_N=response.tension_N if response.tension_N.any() else None,
        current_A=response.effort_N / model.newtons_per_ampere,
        angle_rad=response.angle_rad if response.angle_rad.any() else None,
        reference_N=response.reference_N,
        flags=response.flags,
    )


def floor(**rms):
    channels = {name: Noise(value, 0.0, "quiet stretches") for name, value in rms.items()}
    return NoiseFloor(channels)


SMALL = floor(tension_N=1e-3, angle_rad=1e-5, reference_N=1e-3, current_A=1e-4)


def truth(predictor, *effects):
    """Parameter row with the effects' own values, the model's other values and zeroed encoders."""
    values = {f"{e.name}.{n}": getattr(e, n) for e in effects for n in e.parameters()}
    zeros = {f.name: 0.0 for f in predictor.free if f.name.startswith("encoder_zero")}
    return predictor.row(values | zeros)


def sweep(model):
    """Records of three lengths, preloads, rates and profiles, one of them in closed loop."""
    lengths, rates, preloads = (0.5, 0.9, 1.4), (632.0, 632.0, 1000.0), (15.0, 20.0, 12.0)
    return [
        measure(
            replace(model, cable_length_m=length, sampling_Hz=rate, tension_N=preload),
            replace(profile, preload_N=preload),
            name=f"record {length}",
        )
        for profile, length, rate, preload in zip(PROFILES, lengths, rates, preloads, strict=True)
    ]
