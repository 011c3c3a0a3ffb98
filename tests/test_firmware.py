"""The C controller, compiled by itself and inside the loop, against `estune.core.pidf`."""

import ctypes
import math
import subprocess
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings, PidfState
from estune.errors import PlantError
from estune.hardware import controller_source
from estune.hardware.controller import CompiledController, PlainController, make_controller
from estune.support import c_compiler

SETTINGS = ControllerSettings(632.0, 0.002, -5.0, 120.0)
GAINS = Gains(0.4, 12.0, 0.01, 0.03)

magnitude = st.floats(1e-3, 1e3)
some_gains = st.builds(
    Gains, magnitude, st.just(0.0) | magnitude, st.just(0.0) | magnitude, st.just(0.0) | magnitude
)
signal = st.floats(-200.0, 200.0)


@cache
def compiled() -> CompiledController:
    return CompiledController(controller_source(SETTINGS, GAINS))


def play(controller, gains, other, signals) -> list[tuple[float, bool]]:
    """Efforts of a controller that switches to other gains halfway."""
    controller.rest(signals[0][1], 3.0)
    controller.use(pidf.coefficients(SETTINGS, gains))
    efforts = []
    for k, (r, y) in enumerate(signals):
        if k == len(signals) // 2:
            controller.use(pidf.coefficients(SETTINGS, other))
            controller.take_over(r, y, 7.0)
        efforts.append((controller.step(r, y), controller.limited))
    return efforts


@given(some_gains, some_gains, st.lists(st.tuples(signal, signal), min_size=2, max_size=30))
def test_compiled_controller_equals_the_plain_one(gains, other, signals):
    one = play(compiled(), gains, other, signals)
    two = play(PlainController(), gains, other, signals)
    np.testing.assert_allclose([e for e, _ in one], [e for e, _ in two], rtol=1e-12, atol=1e-9)
    assert one[len(signals) // 2][0] == pytest.approx(7.0, abs=1e-6)


PROGRAM = r"""
#include <stdio.h>
#include "controller.c"
int main(void) {
  estune_pidf reel;
  double r, y, excess, last = 0;
  estune_pidf_init(&reel);
  estune_pidf_at_rest(&reel, 15.0, 14.0);
  while (scanf("%lf %lf", &r, &y) == 2) {
    if (r < 0) {
      estune_pidf_gains(&reel, 1.0, 40.0, 0.015, 0.0);
      estune_pidf_take_over(&reel, -r, y, last);
      r = -r;
    }
    last = estune_pidf_step(&reel, r, y, &excess);
    printf("%.17g %.17g\n", last, excess);
  }
  printf("%g\n", ESTUNE_PIDF_SAMPLING_HZ);
  return 0;
}
"""


@pytest.mark.parametrize(
    ("flags", "tolerance"),
    [(["-std=c90"], 1e-9), (["-std=c17", "-O2"], 1e-9), (["-Dcasadi_real=float"], 1e-3)],
    ids=["C90", "C17", "single precision"],
)
def test_firmware_compiles_alone_and_equals_the_controller(tmp_path, flags, tolerance):
    (tmp_path / "controller.c").write_text(controller_source(SETTINGS, GAINS))
    program = PROGRAM
    if "-Dcasadi_real=float" in flags:
        program = program.replace("double r, y, excess, last", "double r, y; float excess, last")
    (tmp_path / "main.c").write_text(program)
    command = [*c_compiler.compiler(), *flags, "-Wall", "-Wextra", "-Werror", "-pedantic"]
    outputs = [str(tmp_path / "main"), str(tmp_path / "main.c"), "-lm"]
    subprocess.run([*command, "-o", *outputs], check=True)
    rng = np.random.default_rng(0)
    measured = 15.0 + np.cumsum(rng.normal(0.0, 1.0, 200))
    swap_at = 120
    setpoint = np.where(np.arange(200) < 50, 15.0, 25.0)
    text = "\n".join(
        f"{-r if k == swap_at else r!r} {y!r}"
        for k, (r, y) in enumerate(zip(setpoint.tolist(), measured.tolist(), strict=True))
    )
    done = subprocess.run(outputs[0], input=text, capture_output=True, text=True, check=True)
    *lines, rate = done.stdout.splitlines()
    state, c, effort = pidf.state_at_rest(15.0, 14.0), pidf.coefficients(SETTINGS, GAINS), 0.0
    for k, (r, y) in enumerate(zip(setpoint, measured, strict=True)):
        if k == swap_at:
            c = pidf.coefficients(SETTINGS, Gains(1.0, 40.0, 0.015, 0.0))
            state = pidf.bumpless(c, state, r, y, effort)
        state, effort, excess = pidf.step(c, state, r, y)
        computed = tuple(map(float, lines[k].split()))
        assert computed == pytest.approx((effort, excess), rel=tolerance, abs=tolerance)
    assert float(rate) == 632.0


def test_infinite_limits_do_not_limit():
    unlimited = ControllerSettings(632.0, 0.002, -math.inf, math.inf)
    controller = CompiledController(controller_source(unlimited, GAINS))
    controller.use(pidf.coefficients(unlimited, Gains(1e3, 0.0, 0.0, 0.0)))
    controller.rest(0.0, 0.0)
    assert controller.step(1e3, 0.0) == pytest.approx(1e6)
    assert not controller.limited


def test_c_text_names_state_and_coefficients():
    source = controller_source(SETTINGS, GAINS)
    assert ", ".join(PidfState._fields) in source
    assert ", ".join(pidf.Coefficients._fields) in source
    assert ctypes.sizeof(type(compiled()._struct)) == 8 * (9 + 3)


def test_plain_controller_with_a_note_replaces_a_missing_compiler(monkeypatch):
    def none(_source):
        raise PlantError("no C compiler found")

    monkeypatch.setattr(c_compiler, "load", none)
    controller, note = make_controller("")
    assert isinstance(controller, PlainController)
    assert "plain Python: no C compiler" in note
