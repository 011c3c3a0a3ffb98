"""What records cannot tell, found before any effect is."""

from dataclasses import replace

import numpy as np
import pytest

import plants
from plants.models.unloaded_reel import UnloadedReel
from tests.support_measurements import open_loop

RATE_Hz = 500.0
DRIVE = UnloadedReel(sampling_Hz=RATE_Hz, dead_time_s=0.0)


def drive(current_A, *, inertia=2e-3, friction=0.01):
    """Angle of a drum with viscous friction, rounded to encoder steps."""
    velocity, angle, out = 0.0, 0.0, []
    for torque in 0.5 * current_A:
        out.append(angle)
        for _ in range(8):
            velocity += (torque - friction * velocity) / inertia / RATE_Hz / 8
            angle += velocity / RATE_Hz / 8
    step = 2.0 * np.pi / 8192.0
    return np.round(np.array(out) / step) * step


def records(**drum):
    """A sweep and a slow wave."""
    t = np.arange(1500) / RATE_Hz
    for n, current in enumerate([0.1 * np.sin(9.0 * t * t), 0.08 * np.sin(4.0 * t)]):
        yield open_loop(n, RATE_Hz, current, angle_rad=drive(current, **drum))


def kinds(found):
    return [one.kind for one in found.limitations]


@pytest.fixture(scope="module")
def sound():
    return plants.explain(DRIVE, list(records()))


def test_good_records_have_no_limitations(sound):
    assert sound.verdict == "none"
    assert kinds(sound) == []


def test_motion_in_one_direction_is_stated_first():
    t = np.arange(1500) / RATE_Hz
    current = 0.1 + 0.08 * np.sin(4.0 * t)
    one_way = [open_loop(n, RATE_Hz, current, angle_rad=drive(current)) for n in range(2)]
    found = plants.explain(DRIVE, one_way)
    assert "one_direction" in kinds(found)
    assert found.sentence.startswith("all motion is in one direction")
    assert found.to_json()["limitations"][0]["kind"] == "one_direction"


def test_base_parameter_that_moved_far_is_stated():
    assert "base_parameter_moved" in kinds(plants.explain(DRIVE, list(records(inertia=7e-3))))


def test_wrong_sign_or_unit_shows_as_a_parameter_at_its_bound():
    flipped = [replace(m, angle_rad=-m.angle_rad) for m in records()]
    found = plants.explain(DRIVE, flipped, effects=[])
    assert "base_parameter_at_bound" in kinds(found)
    assert found.verdict == "unknown"


def test_nothing_missing_is_not_said_where_most_records_were_refused():
    good = list(records())
    strays = [
        replace(m, rig=f"other{n}", name=f"s{n}", source=f"s{n}") for n, m in enumerate(good * 4)
    ]
    few, most = (plants.explain(DRIVE, [*good, *some]) for some in (strays[:1], strays))
    assert (few.verdict, most.verdict) == ("none", "unknown")
    assert kinds(most)[0] == "records_refused"
