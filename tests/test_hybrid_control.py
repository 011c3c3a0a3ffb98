"""Hybrid position and tension control on the hardware loop, and as C."""

import subprocess

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estune.core import pidf
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.hardware.controller import PlainController
from estune.hardware.hybrid_control import HybridControl
from estune.hardware.trial_board.export import compensation_files
from estune.reel import hybrid
from estune.reel.hybrid import HybridCoefficients, HybridSignals, HybridState
from estune.support import c_compiler
from estune.trial import Setpoint, TrialRequest
from experiments.virtual_loop import virtual_rig
from tests.support_hardware import config, loop_state

HYBRID = {
    "tension_min_N": 8.0,
    "margin_N": 1.0,
    "position": {"P_N_m": 2000.0, "I_N_ms": 60000.0, "D_Ns_m": 60.0, "setpoint_filter_s": 0.05},
}


def rig_file():
    return config(hybrid=HYBRID)


signals = st.tuples(
    st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(0.0, 50.0), st.floats(0.0, 50.0)
)
runs = st.lists(st.tuples(signals, st.booleans()), min_size=2, max_size=30)


def reference(rig, steps):
    """Efforts by `estune.reel.hybrid`."""
    plan = rig.plan()
    c = HybridCoefficients(plan.hybrid.position, plan.live)
    rest = pidf.state_at_rest(steps[0][0][1], 0.0), pidf.state_at_rest(15.0, 5.0)
    state = HybridState(*rest, in_tension=True)
    efforts = []
    for row, in_tension in steps:
        state, effort = hybrid.step(c, state, HybridSignals(*row), in_tension)
        efforts.append(float(effort))
    return efforts


@settings(max_examples=40)
@given(runs)
def test_control_of_the_loop_is_that_of_the_equations(steps):
    rig = rig_file()
    plan, tension = rig.plan(), PlainController()
    tension.use(plan.live)
    tension.rest(15.0, 5.0)
    control = HybridControl(plan.hybrid, tension, PlainController())
    efforts = [control.step(HybridSignals(*row), in_tension=on) for row, on in steps]
    np.testing.assert_allclose(efforts, reference(rig, steps), rtol=1e-9, atol=1e-9)


MAIN = """
#include <stdio.h>
#include "estune_pidf.c"
#include "estune_hybrid.c"
int main(void) {
  static estune_hybrid reel;
  double r_p, p, r_t, t;
  int on;
  estune_hybrid_init(&reel);
  estune_pidf_at_rest(&reel.position, FIRST, 0);
  estune_pidf_at_rest(&reel.tension, 15, 5);
  while (scanf("%lf %lf %lf %lf %d", &r_p, &p, &r_t, &t, &on) == 5) {
    printf("%.17g ", estune_hybrid_step(&reel, 0, 0, r_p, p, r_t, t, on));
    printf("%d %g\\n", estune_hybrid_select(&reel, t, 0), estune_hybrid_setpoint(r_t, on));
  }
  return 0;
}
"""


def test_exported_c_equals_the_equations_and_the_rules(tmp_path):
    rig = rig_file()
    rng = np.random.default_rng(3)
    rows = rng.uniform((-0.02, -0.02, 5.0, 5.0), (0.02, 0.02, 20.0, 20.0), (200, 4))
    on = rng.random(200) < 0.5
    steps = [(tuple(row), bool(o)) for row, o in zip(rows.tolist(), on, strict=True)]
    main = MAIN.replace("FIRST", repr(steps[0][0][1]))
    files = compensation_files(rig) | {"estune_pidf.c": rig.plan().controller, "main.c": main}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    command = [*c_compiler.compiler(), "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    program = str(tmp_path / "main")
    subprocess.run([*command, "-o", program, str(tmp_path / "main.c"), "-lm"], check=True)
    text = "\n".join(f"{' '.join(map(repr, row))} {o:d}" for row, o in steps)
    done = subprocess.run(program, input=text, capture_output=True, text=True, check=True)
    printed = np.array([line.split() for line in done.stdout.splitlines()], float)
    np.testing.assert_allclose(printed[:, 0], reference(rig, steps), rtol=1e-9, atol=1e-9)
    rules = rig.hybrid.rules
    for (row, o), line in zip(steps, printed, strict=True):
        assert line[1] == rules.select(o, row[3], solved=False)
        assert line[2] == pytest.approx(rules.tension_setpoint_N(row[2], solved=o), rel=1e-5)


class Followed:
    """A rig in virtual time that follows setpoints from above."""

    def __init__(self, rig):
        self.rig, self.loop = rig, rig._loop
        rig.run(TrialRequest("h", 0, rig.describe().gains, rig.describe().step))

    def run(self, seconds, setpoint=None):
        """Tensions and currents while a setpoint is followed."""
        rows = []
        for k in range(round(632 * seconds)):
            if setpoint is not None and k % 32 == 0:
                self.rig.follow(setpoint)
            self.loop.sample()
            state = loop_state(self.rig)
            rows.append((state.tension_N, state.current_A, state.angle_rad, state.in_position))
        return np.array(rows).T


def test_position_is_held_where_the_source_asks_for_it_and_switches_are_bumpless():
    with virtual_rig(rig_file()) as rig:
        followed = Followed(rig)
        _, current, angle, _ = followed.run(1.0)
        held = Setpoint(15.0, angle[-1] + 0.03)
        _, into, turned, in_position = followed.run(2.0, held)
        assert in_position.all()
        assert turned[-1] == pytest.approx(held.angle_rad, abs=0.002)
        tension, back, _, in_position = followed.run(2.0, Setpoint(15.0))
        assert not in_position[2:].any()
        assert tension[-1] == pytest.approx(15.0, abs=0.3)
    noise = np.abs(np.diff(current)).max()
    assert abs(into[0] - current[-1]) <= 2.0 * noise
    assert abs(back[0] - into[-1]) <= 2.0 * noise


def test_tension_control_takes_over_where_position_would_let_the_cable_sag():
    with virtual_rig(rig_file()) as rig:
        followed = Followed(rig)
        _, _, angle, _ = followed.run(0.5)
        tension, _, _, in_position = followed.run(
            3.0, Setpoint(15.0, angle[-1] - 0.05)
        )  # 3.5 N there
    assert 0.0 < in_position[-632:].mean() < 1.0
    assert tension.min() > 6.0
    assert tension[-632:].mean() > 8.0


def test_position_is_refused_without_hybrid_control():
    with virtual_rig(config()) as rig, pytest.raises(InvalidInput, match=r"add \[hybrid\]"):
        rig.follow(Setpoint(15.0, 1.0))


def test_hybrid_tension_outside_the_limits_is_refused_when_the_file_is_read():
    with pytest.raises(InvalidInput, match="margin_N 48 N is outside limits"):
        config(hybrid=HYBRID | {"margin_N": 20.0})


def test_position_gains_of_the_plan_are_those_of_the_file():
    rig = rig_file()
    expected = pidf.coefficients(rig.settings(), Gains(2000.0, 60000.0, 60.0, 0.05))
    assert rig.plan().hybrid.position == expected
