"""A diagnosis made up of known numbers, for tests of what is shown of one."""

from dataclasses import replace

import numpy as np

import plants
from estune.recordings.issue import DataIssue
from estune.run.trial_file import TrialFile
from estune.trial.profiles import TriangleProfile
from plants.diagnosis.data.noise_floor import Noise, NoiseFloor
from plants.diagnosis.next_data import NextExperiment
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.residual.localisation import (
    Block,
    ResidualDependence,
    ResidualLocation,
)
from plants.diagnosis.result import (
    BaseParameter,
    Candidate,
    Interval,
    ModelErrors,
    NamedEffect,
    SearchStep,
    Trace,
)
from plants.effects import EFFECTS, EyeletFriction
from plants.effects.plant_scale import CHANNEL_TITLES

RATE_Hz = 632.0
REEL = plants.reference_reel()
FOUND = {"attenuation": 0.931, "inner_share": 0.21, "knee": 0.25, "creep_rad_s": 1e-3}


def interval(value, spread, unit=""):
    return Interval(value, value - spread, value + spread, unit)


def block(name, title, rms, noise_rms, seed):
    random = np.random.default_rng(seed)
    time = np.linspace(0.0, 8.0, 24)
    lines = np.linspace(0.0, RATE_Hz / 2.0, 200)
    power = rms**2 / 30.0 / (1.0 + (lines / 12.0) ** 4) + noise_rms**2 / lines[-1]
    signs = np.array([-1.0, 1.0])
    curves = {
        "velocity sign and tension": (
            *("N", 0.72, np.array([8.0, 16.0, 30.0, 8.0, 16.0, 30.0])),
            rms * np.array([-0.4, -0.8, -1.5, 0.4, 0.8, 1.5]),
        ),
        "velocity sign": ("", 0.63, signs, rms * signs),
        "tension": ("N", 0.18, np.linspace(5.0, 35.0, 12), rms * np.linspace(-1.0, 1.0, 12)),
        "time": ("of the record", 0.02, time / 8.0, 0.1 * rms * random.standard_normal(24)),
        "angle": ("rad", 0.1, np.linspace(-0.1, 0.7, 16), 0.4 * rms * np.sin(np.arange(16))),
        "velocity": ("rad/s", 0.05, np.linspace(0.0, 6.0, 9), 0.2 * rms * np.ones(9)),
    }
    return Block(
        name=name,
        title=title,
        unit="N",
        rms=rms,
        noise_rms=noise_rms,
        smoothing_s=0.004,
        low_Hz=0.2,
        high_Hz=14.0,
        views=tuple(ResidualDependence(name, *curve) for name, curve in curves.items()),
        frequency_Hz=lines,
        power=power,
        noise_power=np.full(200, noise_rms**2 / lines[-1]),
        residual=(np.zeros(8),),
    )


def trace(name, channel, seconds, *, scale, left):
    """A record whose base model is wrong by `scale` and whose augmented one by `left` of it."""
    time = np.arange(int(seconds * RATE_Hz)) / RATE_Hz
    measured = scale * (8.0 + 4.0 * np.sin(2.0 * np.pi * 0.7 * time) + np.sin(30.0 * time))
    wrong = 0.3 * scale * np.sign(np.cos(2.0 * np.pi * 0.7 * time)) * (1.0 + time / seconds)
    noise = 0.01 * scale * np.random.default_rng(5).standard_normal(time.size)
    return Trace(
        name,
        channel,
        channel.rpartition("_")[2],
        time,
        measured + noise,
        measured - wrong,
        measured - left * wrong,
        CHANNEL_TITLES[channel],
    )


def diagnosis(**changes) -> Diagnosis:
    """Eyelet friction, named, with everything that may be told of it."""
    eyelet = NamedEffect(
        name="eyelet_friction",
        title=EyeletFriction.title,
        parameters={
            "attenuation": interval(0.931, 0.0031),
            "inner_share": interval(0.21, 0.02),
        },
        sentence=EyeletFriction.sentence(FOUND, REEL),
        effect=EyeletFriction(**FOUND),
    )
    candidates = [
        Candidate("eyelet_friction", 0.997, 1.2, 0.61, "it closes 99.7 % of the gap"),
        Candidate("coulomb_friction", 0.52, 9.8, 0.33, "it leaves 9.8 floors"),
        Candidate("dahl_hysteresis", 0.55, 9.4, 0.31, "it leaves 9.4 floors"),
    ]
    candidates += [
        Candidate(name, np.nan, np.nan, 0.001, "it explains 0.1 % of the residual")
        for name in EFFECTS
        if name not in {"eyelet_friction", "coulomb_friction", "dahl_hysteresis", "backlash"}
    ]
    channels = {
        "tension_N": Noise(0.041, 0.0, "periods"),
        "angle_rad": Noise(2.2e-4, 7.7e-4, "steps"),
    }
    made = Diagnosis(
        verdict="named",
        sentence=(
            "Friction at the eyelet is missing from the model: with it the gap falls from 0.58 N "
            "to 0.047 N, and the noise floor is 0.043 N."
        ),
        effects=(eyelet,),
        ambiguous=(),
        candidates=tuple(candidates),
        unit="N",
        given=ModelErrors(0.66, 15.8, 1.02),
        before=ModelErrors(0.58, 13.9, 0.91),
        after=ModelErrors(0.047, 1.2, 0.09),
        floor=0.043,
        noise=NoiseFloor(channels),
        where=ResidualLocation(
            blocks=(
                block("gauge", "cable and gauge", 0.62, 0.05, 1),
                block("force", "balance of forces", 0.11, 0.06, 2),
            ),
            sentence=(
                "What the refitted model leaves unexplained in the cable and gauge is 12 times "
                "the noise. 63 % of it depends only on the direction of motion"
            ),
        ),
        unexplained=ResidualLocation(
            blocks=(),
            sentence="The model with the effects leaves nothing unexplained above the noise",
        ),
        calibrations=(
            BaseParameter(
                "drum_inertia_kg_m2", "kg m2", 2e-3, interval(2.31e-3, 4e-5),
                interval(2.01e-3, 1e-5),
            ),
            BaseParameter(
                "viscous_friction_Nms", "N m s/rad", 0.022, interval(0.045, 4e-3),
                interval(0.0224, 8e-4),
            ),
            BaseParameter("gauge_offset_N", "N", 0.0, interval(0.3, 0.05), interval(0.01, 0.02)),
        ),
        not_excited={
            "backlash": "the tension never fell below 3 N",
            "drum_eccentricity": "the drum turned only 0.13 of a turn",
        },
        next_experiment=None,
        findings=(
            DataIssue("refused", "this is nan; remove the row", "tension_N", 17, "runs/bad.csv"),
            DataIssue("warning", "0.4 s is short; record 2 s or more", source="runs/short.csv"),
        ),
        steps=(
            SearchStep(None, 0.58, 0.043, 13.9),
            SearchStep("eyelet_friction", 0.047, 0.043, 1.2),
        ),
        traces=(
            trace("triangle-3", "tension_N", 6.0, scale=1.0, left=0.05),
            trace("triangle-3", "angle_rad", 6.0, scale=0.05, left=0.04),
            trace("step-9", "tension_N", 1.0, scale=0.5, left=0.05),
        ),
        model=REEL,
        base_model=REEL,
        augmented=REEL + EyeletFriction(**FOUND),
        values={"eyelet_friction.attenuation": 0.931},
    )  # fmt: skip
    return replace(made, **changes)


NO_BLOCKS = replace(diagnosis().where, blocks=(), sentence="")
"""A residual without the figures that take most of a page's time."""


def deciding() -> NextExperiment:
    """A slow triangle that would tell two kinds of friction apart."""
    why = "a slow triangle tells coulomb_friction and dahl_hysteresis apart: by 3.1 sigmas"
    profile = TriangleProfile(15.0, 8.0, period_s=4.0, duration_s=8.2, start_s=0.2, loop="open")
    return NextExperiment(TrialFile("triangle-slow", profile, why=why), why, 9.6, {"chirp": 0.1})


def nothing_found(**changes) -> Diagnosis:
    """A gap at the noise floor: nothing was added."""
    same = trace("triangle-3", "tension_N", 6.0, scale=1.0, left=1.0)
    return diagnosis(
        verdict="none",
        sentence="Simulation and measurement agree to within the noise.",
        effects=(),
        before=ModelErrors(0.045, 1.05, 0.91),
        after=ModelErrors(0.045, 1.05, 0.91),
        steps=(SearchStep(None, 0.045, 0.043, 1.05),),
        traces=(replace(same, after=same.before),),
        augmented=REEL,
        unexplained=NO_BLOCKS,
        **changes,
    )
