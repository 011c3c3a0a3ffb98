"""Whether it is the tuning or the machine: the cause of what a log shows."""

import json
from dataclasses import replace

import numpy as np
import pytest

from estune.cli import main
from estune.recordings.loop_log import LoopLog
from estune.service_records.cause.beside_loop import with_better, with_margins
from estune.service_records.cause.judge import (
    between_limits,
    judge_cause,
    judge_signals,
    of_most,
)
from estune.service_records.cause.loop_signals import LONGEST, JudgedSignals
from estune.service_records.cause.sensor import frozen as sensor_frozen
from estune.service_records.cause.sensor import spikes
from estune.service_records.cause.valve import Valve, positions

SAMPLES = 1200


def flow_loop(band=0.0, slip=0.0, load=0.0, sensor=lambda _k, y: y, I=0.05):
    """Signals of a flow loop of gain 2 behind an actuator that may stick."""
    random = np.random.default_rng(3)
    setpoint = np.repeat([50.0, 51.0, 50.5, 50.0, 51.5, 50.5], SAMPLES // 6)
    y, u, flow, at, integral, slow = [], [], 50.0, 25.0, 25.0, 0.0
    for k, r in enumerate(setpoint.tolist()):
        slow += 0.01 * (random.normal() - slow)
        flow += 0.5 * (2.0 * at + 0.3 * slow + load * np.sin(2.0 * np.pi * k / 37.0) - flow)
        measured = sensor(k, flow + 0.03 * random.normal())
        integral += I * (r - measured)
        output = 0.1 * (r - measured) + integral
        if abs(output - at) > 0.5 * (band + slip) or band == 0.0:
            at = output - np.sign(output - at) * 0.5 * (band - slip)
        y.append(measured)
        u.append(output)
    return JudgedSignals(setpoint, np.array(y), np.array(u), 10.0)


def test_sticking_actuator_is_told_with_its_band_inside_the_interval():
    found = judge_signals(flow_loop(band=1.5, slip=0.9))
    assert found.name == "sticking"
    assert found.numbers["band_low"] <= 1.5 <= found.numbers["band_high"]
    assert found.numbers["slip_low"] <= 0.9 <= found.numbers["slip_high"]


def test_sticking_actuator_of_a_fast_loop_is_told():
    assert judge_signals(flow_loop(band=1.5, slip=0.9, I=0.3)).name == "sticking"


def test_sound_loop_has_nothing_wrong():
    assert judge_signals(flow_loop()).name == "none"


def test_wave_from_outside_is_told_with_its_period():
    found = judge_signals(flow_loop(load=1.0))
    assert found.name == "outside"
    assert found.numbers["period_s"] == pytest.approx(370.0, rel=0.05)


def frozen(k, y, held=[]):  # noqa: B006  the reading that is held
    if k == 400:
        held[:] = [y]
    return held[0] if 400 <= k < 600 else y


@pytest.mark.parametrize(
    ("fault", "sensor"),
    [
        ("frozen", frozen),
        ("steps", lambda _k, y: round(2.0 * y) / 2.0),
        ("spikes", lambda k, y: y + 3.0 * (k % 211 == 100)),
    ],
)
def test_fault_of_the_sensor_is_named(fault, sensor):
    found = judge_signals(flow_loop(sensor=sensor))
    assert (found.name, found.numbers["fault"]) == ("sensor", fault)


def test_spikes_are_counted_once_and_have_their_height():
    spiked = judge_signals(flow_loop(sensor=lambda k, y: y + 3.0 * (k % 211 == 100)))
    assert spiked.numbers["count"] == SAMPLES // 211 + (SAMPLES % 211 > 100)
    assert spiked.numbers["size"] == pytest.approx(3.0, rel=0.1)


def test_kinks_of_a_measurement_after_steps_of_the_setpoint_are_no_spikes():
    k = np.arange(2000)
    answer = np.clip(k % 100, 0, 3) / 3.0  # it rises for three samples
    y = np.where(k // 100 % 2, answer, 1.0 - answer) + 0.003 * np.random.default_rng(1).normal(
        size=k.size
    )
    assert spikes(JudgedSignals(np.zeros_like(y), y, y, 1.0)) is None


def test_reading_frozen_several_times_is_frozen():
    rng = np.random.default_rng(2)
    y = np.cumsum(rng.normal(size=2000)) + rng.normal(size=2000)
    for at in (300, 900, 1500):
        y[at : at + 40] = y[at]
    found = sensor_frozen(JudgedSignals(np.zeros_like(y), y, np.arange(2000.0), 1.0))
    assert found is not None
    assert (found.fault, found.number) == ("frozen", 39)


def test_reading_that_stands_while_the_output_rests_is_not_frozen():
    k = np.arange(2000)
    u = np.where(k < 1000, 0.0, k - 1000.0)
    y = np.where(k < 1002, 0.0, k - 1002.0) + 0.1 * np.sin(k) * (k >= 1002)
    assert sensor_frozen(JudgedSignals(np.zeros_like(y), y, u, 1.0)) is None


def test_servo_that_settles_within_a_thousandth_of_its_log_is_thinned_to_its_own_pace():
    t = np.arange(32000) / 2000.0
    setpoint = np.floor(2.0 * t) % 2.0
    after = np.exp(-(t % 0.5) / 0.015) * np.where(setpoint > 0.0, 1.0, -1.0)
    thinned = JudgedSignals(setpoint, setpoint - after, after, 1 / 2000.0).thinned()
    assert thinned.samples == LONGEST
    assert thinned.interval_s <= 0.005


def test_log_too_short_to_judge_says_what_to_record():
    few = JudgedSignals(*(x[:60] for x in flow_loop()[:3]), 10.0)
    found = judge_signals(few)
    assert found.name == "unknown"
    assert "record 100 or more" in found.heading()


def test_cause_of_several_logs_is_that_of_most_and_the_others_are_named():
    sticks, freezes = flow_loop(band=1.5, slip=0.9), flow_loop(sensor=frozen)
    names = {"a": sticks, "b": freezes, "c": sticks}
    columns = ("setpoint", "measurement", "effort")
    logs = [
        LoopLog(name, 0.1, (loop_columns(columns, signals),), None, {}, {}, ())
        for name, signals in names.items()
    ]
    found = of_most([judge_cause(log) for log in logs])
    assert found.name == "sticking"
    assert "2 of 3 logs" in found.words
    assert "SENSOR in b" in found.words


def loop_columns(names, signals):
    return {"time": 10.0 * np.arange(SAMPLES), **dict(zip(names, signals[:3], strict=True))}


def test_output_that_is_at_a_limit_throughout_shows_no_cause():
    plain = flow_loop()
    switched = plain._replace(output=np.where(plain.error > 0.0, 100.0, 0.0))
    assert "as of an on-off controller" in judge_signals(between_limits(switched)).heading()


def test_measurement_that_runs_away_is_said_before_any_cause():
    found = judge_signals(flow_loop(I=-0.02))
    assert found.name == "unknown"
    assert "runs away from the setpoint" in found.heading()
    assert "right direction" in found.heading()


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_cause_does_not_depend_on_units(scale):
    plain = flow_loop(band=1.5, slip=0.9)
    scaled = JudgedSignals(scale * plain.setpoint, scale * plain.measurement, plain.output, 10.0)
    a, b = judge_signals(plain), judge_signals(scaled)
    assert b.probability == pytest.approx(a.probability, rel=1e-6)
    assert b.numbers["band"] == pytest.approx(a.numbers["band"])


def test_actuator_rests_until_the_output_is_a_band_ahead():
    output = np.concatenate([np.linspace(0.0, 3.0, 301), np.linspace(3.0, 0.0, 301)])
    at = positions(output, [Valve(1.0, 0.0)])[:, 0]
    assert at[300] == pytest.approx(2.5)
    assert at[300:401] == pytest.approx(2.5, abs=0.011)
    assert at[-1] == pytest.approx(0.5, abs=0.011)


def test_tuning_is_the_cause_where_the_margins_are_known_to_be_small_and_there_alone():
    waved = judge_signals(flow_loop(load=1.0))
    assert with_margins(waved, (2.5, 2.2, 2.9)).name == "tuning"
    assert with_margins(waved, (1.9, 1.6, 2.3)) is waved
    slow = replace(waved, name="tuning", numbers={"direction": "slow"})
    assert with_margins(slow, (3.0, 2.9, 3.1)).numbers["direction"] == "tight"
    tight = replace(waved, name="tuning", numbers={"direction": "tight"})
    assert with_margins(tight, (1.3, 1.2, 1.4)).name == "outside"
    sticks = with_margins(judge_signals(flow_loop(band=1.5, slip=0.9)), (2.5, 2.2, 2.9))
    assert sticks.name == "sticking"
    assert "too tight as well" in sticks.heading()


def test_a_first_line_agrees_with_gains_that_cost_far_less():
    waved = judge_signals(flow_loop(load=1.0))
    sound = replace(waved, name="none", numbers={}, words="the loop is sound")
    assert "too slow, Ms 1.03; a step costs 93% less" in with_better(sound, 1.03, 0.07, 0.2).words
    assert with_better(sound, 1.3, 0.4, 2.0).heading().startswith("NOTHING WRONG")
    assert "a step costs 60% less" in with_better(sound, 1.3, 0.4, 2.0).words
    assert with_better(sound, 1.3, 0.9, 0.5) is sound
    assert with_better(waved, 1.3, 0.1, 0.5) is waved


def said(capsys, *arguments):
    """Exit code and what was printed."""
    with pytest.raises(SystemExit) as ended:
        main([*arguments])
    return ended.value.code, capsys.readouterr().out


def test_sticking_actuator_is_the_first_line_and_no_gains_are_offered(tmp_path, capsys):
    signals = flow_loop(band=1.5, slip=0.9)
    rows = zip(*signals[:3], strict=True)
    lines = [f"{10 * k},{r},{y},{u}" for k, (r, y, u) in enumerate(rows)]
    path = tmp_path / "flow.csv"
    path.write_text("\n".join(["time_s,setpoint,measurement,output", *lines]))
    code, out = said(capsys, "suggest", str(path), "--gains", "P=0.1,I=0.005")
    assert out.startswith("STICKING ACTUATOR")
    assert (code in (9, 10), "CHANGE" in out) == (True, False)


def test_cause_is_told_alone_where_no_gains_explain_the_output(tmp_path, capsys):
    signals = flow_loop(band=1.5, slip=0.9)
    output = signals.output + np.random.default_rng(1).normal(0.0, 0.05, SAMPLES)
    rows = zip(signals.setpoint, signals.measurement, output, strict=True)
    lines = [f"{10 * k},{r},{y},{u}" for k, (r, y, u) in enumerate(rows)]
    path = tmp_path / "flow.csv"
    path.write_text("\n".join(["time_s,setpoint,measurement,output", *lines]))
    report = tmp_path / "cause.html"
    code, out = said(capsys, "suggest", str(path), "--json", "--report", str(report))
    found = json.loads(out)
    assert (code, found["verdict"], found["cause"]["name"]) == (0, "no gains", "sticking")
    assert "gains that ran" in found["reason"]
    assert "Tuning or machine" in report.read_text()
