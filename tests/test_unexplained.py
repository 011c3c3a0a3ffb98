"""Where a model leaves something: the variable it lies over, and what is drawn of it."""

import pytest

import plants
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.report import summary
from plants.diagnosis.report.page import page
from plants.diagnosis.residual.localisation import localise
from tests.support_joints import Joint, record, turned

KINDS = {
    "complete": (Joint(), None),
    "coulomb": (Joint(dry=6e-3), "velocity sign"),
    "load": (Joint(share=0.3), "velocity sign and load"),
    "cogging": (Joint(cogging=6e-3), "position period"),
    "warming": (Joint(warming=0.8), "time"),
    "resonance": (Joint(elastic=1.0), "frequency"),
}
TWO = Joint(dry=0.02, cogging=8e-3)


@pytest.fixture(scope="module")
def joints():
    """Angle and torque of a joint of each kind; a mode has to be excited to be seen."""
    moved = turned([*(kind for kind, _ in KINDS.values()), TWO])
    swept = turned([KINDS["resonance"][0]], sweep_rad=0.03)
    return dict(zip([*KINDS, "two"], moved, strict=True)) | {"resonance": swept[0]}


@pytest.mark.parametrize("kind", KINDS)
def test_residual_lies_over_the_variable_of_the_law_that_is_missing(joints, kind):
    m, model = record(joints[kind], 16)
    left = localise([m], [BaseNumbers.of(model, m)], noise_floor([m]))
    (block,) = left.blocks
    strongest = KINDS[kind][1]
    if strongest is None:
        assert not block.is_above_noise
        assert max(view.share for view in block.views) < 0.1
    else:
        assert block.regime is not None
        assert block.regime.name == strongest
        assert block.views[0].share == max(view.share for view in block.views)


def test_what_a_named_effect_leaves_is_located_without_that_effect(joints):
    m, model = record(joints["two"], 16)
    found = plants.explain(model, [m], effects=["coulomb_friction", "dead_time"])
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert found.where.blocks[0].regime.name == "velocity sign"
    left = found.unexplained.blocks[0]
    assert left.regime.name == "position period"
    share = next(view.share for view in left.views if view.name == "velocity sign")
    assert share < 0.1
    assert summary.sentences(found)[-1].startswith("What the model with the effects leaves")
    assert "What is unexplained" in [section.title for section in page(found).sections]
