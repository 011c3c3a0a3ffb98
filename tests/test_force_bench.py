"""The felt force of a reel: its figures against closed forms, and the command with its page."""

import json
import math
import time

import numpy as np
import pytest

from estune.cli import run
from estune.core.gains import Gains
from estune.errors import InvalidInput
from plants.bench.cable_platform import bench_carriage
from plants.bench.cable_platform.force_benches import SimulatedForceBench, open_benches
from plants.bench.felt_force.felt_force import felt_force
from plants.bench.felt_force.force_procedure import ForceSample, ForceTest
from plants.bench.felt_force.outside_force import with_outside_force
from plants.models.reel import SAFE_GAINS, reference_reel
from tests.test_setpoints import served_bench

TUNED = Gains(P=1.055, I=28.1, D=0.0178, setpoint_filter_s=0.0018)
"""Gains of the reference reel by `estune tune plants:reference_reel`, to three digits."""

TEST = ForceTest()


class LaggingBench:
    """A bench in closed form: a lag from the command, an eyelet's friction, and a mass."""

    period_s = 1.0 / 200.0

    def __init__(self, lag_s: float, friction_N: float, mass_kg: float) -> None:
        self.lag_s, self.friction_N, self.mass_kg = lag_s, friction_N, mass_kg
        self.time_s, self.lagged, self.positions = 0.0, 15.0, [0.0, 0.0, 0.0]

    def use(self, gains: Gains) -> None:
        """Has no gains."""

    def exchange(self, command_N: float, position_m: float) -> ForceSample:
        """One period."""
        self.time_s += self.period_s
        share = -math.expm1(-self.period_s / self.lag_s)
        self.lagged += share * (command_N - self.lagged)
        self.positions = [*self.positions[1:], position_m]
        first, second, third = self.positions
        push = self.mass_kg * (third - 2.0 * second + first) / self.period_s**2
        felt = self.lagged + self.friction_N * np.sign(third - second) + push
        return ForceSample(self.time_s, felt, self.lagged, position_m)


def measure(bench, command_N: float = 15.0):
    return felt_force(TEST.run(bench, command_N), TEST, bench.period_s)


def test_figures_of_a_lag_with_friction_are_those_of_its_closed_form():
    felt = measure(LaggingBench(lag_s=0.04, friction_N=0.7, mass_kg=0.0))
    assert felt.bandwidth_Hz == pytest.approx(1.0 / (2.0 * math.pi * 0.04), rel=0.05)
    assert felt.hysteresis_N == pytest.approx(1.4, rel=1e-3)
    assert felt.error_rms_N == pytest.approx(0.7, rel=1e-3)
    assert felt.gauge_rms_N == pytest.approx(0.0, abs=1e-9)
    lag = 1.0 / np.abs(1.0 + 2j * np.pi * felt.frequencies_Hz * 0.04)
    assert np.abs(felt.ratio)[:12] == pytest.approx(lag[:12], rel=0.1)


def test_bandwidth_above_all_frequencies_is_none_and_mass_is_felt_in_motion():
    light, heavy = (measure(LaggingBench(1e-4, 0.0, mass)) for mass in (0.5, 1.0))
    assert light.bandwidth_Hz is None
    assert heavy.error_rms_N == pytest.approx(2.0 * light.error_rms_N)


@pytest.mark.slow
def test_simulated_reel_hysteresis_is_of_the_eyelets_and_bandwidth_of_the_gains():
    reel, B = reference_reel(), 0.95
    bench = SimulatedForceBench(bench_carriage(reel, reel, (B, B)))
    before = measure(bench)
    bench.use(TUNED)
    after = measure(bench)
    for felt in (before, after):
        # Pulled out, the outside has T/B; wound in, B T.
        assert felt.hysteresis_N == pytest.approx((1.0 / B - B) * 15.0, rel=0.05)
    assert after.bandwidth_Hz > 2.0 * before.bandwidth_Hz
    assert after.gauge_rms_N < before.gauge_rms_N


def test_far_end_at_rest_is_refused():
    bench = LaggingBench(0.04, 0.0, 0.0)
    record = TEST.run(bench, 15.0)
    record.position_m[:] = 0.0
    with pytest.raises(InvalidInput, match="did not move"):
        felt_force(record, TEST, bench.period_s)


def test_outside_force_of_a_file_replaces_that_of_the_bench(tmp_path):
    record = TEST.run(LaggingBench(0.04, 0.0, 0.0), 15.0)
    path, clock_s = tmp_path / "sensor.csv", 1.7e9
    stamps = np.arange(clock_s, clock_s + 40.0, 0.01)
    rows = (f"{stamp!r},{stamp - clock_s!r}" for stamp in stamps.tolist())
    path.write_text("\n".join(["time_s,force_N", *rows]))
    replaced = with_outside_force(record, path, clock_s)
    assert replaced.felt_N == pytest.approx(record.time_s, abs=1e-6)
    with pytest.raises(InvalidInput, match="during the whole test"):
        with_outside_force(record, path, clock_s + 30.0)
    path.write_text("t,force_N\n1,2\n")
    with pytest.raises(InvalidInput, match="needs time_s"):
        with_outside_force(record, path, clock_s)


@pytest.mark.usefixtures("undrawn")
def test_command_writes_a_page_and_prints_both_gains(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ["--part", "5", "--force", "15", "--json"]
    assert run(["bench", "--gain", "P=1.055", "--gain", "I=28.1", *options]) == 0
    printed = json.loads(capsys.readouterr().out)["x"]
    assert set(printed) == {"before", "after"}
    assert printed["after"]["gains"]["P"] == 1.055
    assert [each["command_N"] for each in printed["before"]["forces"]] == [15.0]
    page = (tmp_path / "bench.html").read_text()
    assert "Felt force" in page
    assert page.count("data:image/svg+xml") > 0
    assert run(["bench", "--gain", "Q=1"]) == InvalidInput.exit_code
    assert run(["bench", "--force", "50"]) == InvalidInput.exit_code
    assert run(["bench", "plants:unloaded_reel"]) == InvalidInput.exit_code


def test_bench_over_the_link_moves_the_far_end_and_restores_the_gains():
    with served_bench() as (platform, servers):
        endpoints = [server.endpoint for server in servers]
        with open_benches(endpoints, 0.025) as (x, y):
            assert (x.label, y.label) == ("x", "y")
            x.bench.use(TUNED)
            assert platform.simulation.gains[0] == TUNED
            began_s = time.monotonic()
            while (sample := x.bench.exchange(20.0, 0.01)).position_m < 0.008:
                assert time.monotonic() - began_s < 60.0
            assert sample.felt_N != sample.tension_N  # the sensor outside
        assert platform.simulation.gains[0] == SAFE_GAINS
