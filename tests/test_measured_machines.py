"""Verdicts of `explain` on measured machines; the data are not part of the project.

EMPS: a positioning drive (Janot, Gautier & Brunot 2019). Inverse dynamics by least squares give
95.1 kg, 203.4 N s/m, Coulomb friction of 20.4 N and an offset of -3.2 N. Silverbox: an electronic
oscillator with a cubic spring (Wigren & Schoukens 2013).
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import plants
from experiments import silverbox
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.models.unloaded_reel import UnloadedReel

DATA = silverbox.folder(None)
NEWTONS_PER_VOLT, RECORDED_Hz = 35.1507, 1000


def measured(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is absent; name the folder with ESTUNE_DATA")
    return path


def emps(pieces: int, rate_Hz: int) -> list[MeasuredRecord]:
    """The EMPS record, sampled at a rate and cut into files."""
    from scipy.io import loadmat  # noqa: PLC0415  slow to import

    found = loadmat(measured("emps/DATA_EMPS.mat"))
    position_m, force_N = found["qm"].ravel(), NEWTONS_PER_VOLT * found["vir"].ravel()
    step = RECORDED_Hz // rate_Hz
    samples = position_m.size // step
    position_m = position_m[: samples * step : step]
    force_N = force_N[: samples * step].reshape(samples, step).mean(axis=1)
    edges = np.linspace(0, samples, pieces + 1).astype(int)
    return [
        MeasuredRecord(
            name=f"emps{a}",
            rig="emps",
            sampling_Hz=float(rate_Hz),
            cable_length_m=None,
            preload_N=0.0,
            loop="closed",
            profile="custom",
            gains=None,
            time_s=np.arange(b - a) / rate_Hz,
            setpoint_N=None,
            current_A=force_N[a:b],
            tension_N=None,
            angle_rad=position_m[a:b],
            reference_N=None,
            flags=None,
        )
        for a, b in pairwise(edges)
    ]


def carriage(rate_Hz: int) -> UnloadedReel:
    """A mass with viscous friction: a radius of 1 m makes kilograms of its inertia."""
    return UnloadedReel(
        sampling_Hz=float(rate_Hz),
        torque_constant_Nm_A=1.0,
        drum_radius_m=1.0,
        drum_inertia_kg_m2=95.0,
        viscous_friction_Nms=200.0,
        dead_time_s=0.0,
        encoder_counts=2.0 * np.pi / 5e-8,
        current_limit_A=1e6,
    )


@pytest.mark.parametrize(("pieces", "rate_Hz"), [(1, 250), (5, 250), (1, 100), (3, 100)])
def test_friction_of_a_measured_drive_is_identified_however_its_record_is_cut(pieces, rate_Hz):
    found = plants.explain(carriage(rate_Hz), emps(pieces, rate_Hz))
    assert found.verdict in ("named", "incomplete")
    (friction,) = found.effects
    assert friction.name == "coulomb_friction"
    size = friction.parameters["torque_Nm"]
    assert size.low < 20.4 < size.high
    assert size.value == pytest.approx(20.4, rel=0.05)
    numbers = {one.name: one.with_effects for one in found.calibrations}
    assert numbers["drum_inertia_kg_m2"].value == pytest.approx(95.1, rel=0.02)
    assert numbers["viscous_friction_Nms"].value == pytest.approx(203.4, rel=0.06)
    assert found.gap_after < 0.35 * found.gap_before


def test_cubic_spring_of_a_measured_oscillator_is_identified():
    measured("silverbox/Silverbox.mat")
    figures = silverbox.figures(DATA)
    assert figures["silverbox_stiffening_first"] == 1.0
    assert figures["silverbox_nrmse_after"] <= 0.025
