"""Verdicts on drives whose simulator shares no code with the models."""

import math

import numpy as np
import pytest

import plants
from experiments.independent_drives.drives import draw
from experiments.independent_drives.logs import Logger
from plants.models.model_file import load_model


def test_current_limit_is_found_though_a_friction_made_up_for_it(tmp_path):
    """The base fit takes 700 times the viscous friction, with which the limit shows nothing."""
    drive = draw("servo", 6, 3002)
    rng = np.random.default_rng([3002, 6, 1, *b"servo"])
    logger = Logger.drawn("servo", rng)
    logger.write(drive, tmp_path, rng)
    d = plants.explain(
        load_model(tmp_path / "model.toml"),
        tmp_path / "logs",
        columns=logger.columns,
        effects=["current_saturation", "bent_viscous_friction"],
    )
    assert [effect.name for effect in d.effects] == ["current_saturation"]
    limit = d.effects[0].parameters["limit_A"]
    assert limit.value == pytest.approx(drive.numbers["limit"], rel=0.03)
    # Only one of the records reaches the limit: the other says nothing of it.
    assert limit.low < drive.numbers["limit"] < limit.high < 1.2 * limit.low


def test_gravity_of_a_link_points_where_the_encoder_says(tmp_path):
    """Records with zeros of their own shift the phase of a wave with them, which is no angle."""
    drive = draw("link", 1, 3002)
    rng = np.random.default_rng([3002, 1, 1, *b"link"])
    logger = Logger.drawn("link", rng)
    logger.write(drive, tmp_path, rng)
    d = plants.explain(
        load_model(tmp_path / "model.toml"),
        tmp_path / "logs",
        columns=logger.columns,
        effects=["link_gravity"],
    )
    phase = d.effects[0].parameters["phase_rad"]
    told = d.effects[0].effect.phase_rad
    assert told == phase.value
    error = math.remainder(drive.numbers["gravity_angle"] - phase.value, 2.0 * math.pi)
    assert phase.low < phase.value + error < phase.high < phase.low + 0.1
