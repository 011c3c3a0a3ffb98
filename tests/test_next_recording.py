"""What to record next: within what the records show, for every kind of model."""

import control
import numpy as np
import pytest

import plants
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.experiments.next_recording import next_recording
from plants.diagnosis.models.base import BaseNumbers
from plants.effects.plant_scale import PlantScale

RATE_Hz = 250.0
TIME = np.arange(5000) / RATE_Hz
MOVED = 0.3 + 1.5 * np.sin(1.3 * TIME) + 0.4 * np.sin(4.0 * TIME)


def record(loop, **columns):
    return MeasuredRecord(
        name="one", rig="rig", sampling_Hz=RATE_Hz, loop=loop, time_s=TIME, **columns
    )


def following(model, m):
    return next_recording([m], [BaseNumbers.of(model, m)], PlantScale.of(model))


@pytest.mark.parametrize(
    ("model", "column"),
    [
        (plants.servo(1e-3, 1e-3, sampling_Hz=RATE_Hz), "angle_rad"),
        (plants.stage(2.0, 8.0, sampling_Hz=RATE_Hz), "position_m"),
    ],
)
def test_motion_of_a_drive_stays_within_travel_speed_and_acceleration(model, column, tmp_path):
    seen = record("closed", current_A=np.cos(TIME), angle_rad=MOVED)
    path = following(model, seen).write(tmp_path)
    time_s, way = np.loadtxt(path, delimiter=",", skiprows=1, unpack=True)
    assert path.read_text("utf-8").startswith(f"time_s,{column}\n")
    assert MOVED.min() < way.min() < way.max() < MOVED.max()
    speed, step = np.gradient(way, time_s), np.gradient(np.gradient(MOVED, TIME), TIME)
    assert np.abs(speed).max() < np.abs(np.gradient(MOVED, TIME)).max()
    assert np.abs(np.gradient(speed, time_s)).max() < 1.1 * np.abs(step).max()
    # Slow and fast, and about as long one way as the other.
    moving = np.abs(speed[np.abs(speed) > 1e-3])
    assert np.quantile(moving, 0.2) < 0.1 * moving.max()
    assert np.mean(speed > 1e-3) == pytest.approx(np.mean(speed < -1e-3), abs=0.02)


SLOW = plants.linear_plant(control.tf([2.0], [10.0, 1.0]), sampling_Hz=RATE_Hz)
FREE = plants.linear_plant(
    control.tf([1.0], [1.0, 0.1, 0.0]), sampling_Hz=RATE_Hz, settling_time_s=20.0
)


@pytest.mark.parametrize(
    ("model", "loop", "head", "of"),
    [
        (SLOW, "open", "command", "setpoint_N"),
        (SLOW, "closed", "setpoint", "tension_N"),
        (FREE, "open", "setpoint", "tension_N"),  # a command that is held moves it without end
        (plants.reference_reel(), "closed", "setpoint", "tension_N"),
    ],
)
def test_stairs_of_a_plant_stay_within_what_was_commanded_or_read(model, loop, head, of, tmp_path):
    columns = {"setpoint_N": 4.0 + np.sin(TIME), "tension_N": 7.0 + 2.0 * np.sin(TIME)}
    seen = record(loop, **columns, current_A=np.cos(TIME), preload_N=5.0, cable_length_m=1.0)
    path = following(model, seen).write(tmp_path)
    assert path.read_text("utf-8").startswith(f"time_s,{head}\n")
    _, levels = np.loadtxt(path, delimiter=",", skiprows=1, unpack=True)
    assert columns[of].min() < levels.min() < levels.max() < columns[of].max()


def test_records_that_rest_say_what_to_record_without_a_table(tmp_path):
    rests = record("closed", current_A=np.cos(TIME), angle_rad=np.zeros(TIME.size))
    said = following(plants.servo(1e-3, 1e-3), rests)
    assert "slow and fast motion both ways" in said.sentence
    assert said.write(tmp_path) is None
