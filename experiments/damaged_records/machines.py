"""Small records of machines: simulated ones, and measured ones where their files are there."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import control
import numpy as np

import plants
from estune.core.quantities import FloatArray
from estune.recordings.column_map import AS_NAMED, ColumnMap
from estune.trial import TrialRequest
from estune.trial.profiles import MultisineProfile
from plants.effects import CoulombFriction

Table = dict[str, FloatArray]
"""Columns by name, the first of them the time."""

ROWS = 1500
"""Most rows of a measured record: a diagnosis is to take about a CPU second."""

MEASURED = {
    "servo_xl330": (("kp100_sin_sin", "kp400_sin_time_square"), ("t", "torque", "angle")),
    "pendulum": (("ddp", "swing_up_limited"), ("time", "torque", "position")),
    "winch_motor": (("nocomp_0", "comp_1"), ("time_s", "current_A", "angle_rad")),
}
"""Files of measured machines, and their columns of time, command and angle."""


class Machine(NamedTuple):
    """A machine.

    Attributes:
        name: Name.
        model: The model given of it, which lacks something.
        tables: Its records.
        columns: Map of their columns.
    """

    name: str
    model: Any
    tables: tuple[Table, ...]
    columns: ColumnMap = AS_NAMED


def machines(data: Path) -> list[Machine]:
    """The machines.

    Args:
        data: Folder of measured machines.
    """
    return [reel(), joint(), stage(), process(), *measured(data)]


def reel() -> Machine:
    """Step and multisine of a reel with friction, in closed loop."""
    model = plants.reference_reel()
    rig = plants.reference_reel(effects=(CoulombFriction(0.02),)).rig()
    about = rig.describe()
    sines = MultisineProfile(20.0, 2.0, 0.8, 1, 60, duration_s=1.0, start_s=0.2)
    step = TrialRequest("r", 0, about.gains, about.step)
    excited = TrialRequest("r", 1, about.gains, sines)
    tables = []
    for record in (rig.run(step), rig.run(excited)):
        names = ("time_s", "setpoint_N", "current_A", "tension_N", "angle_rad")
        tables.append({name: np.asarray(getattr(record, name)) for name in names})
    return Machine("reel", model, tuple(tables))


def joint() -> Machine:
    """A joint with dry friction and the gravity of a link, 200 Hz."""
    t = np.arange(1200) / 200.0
    tables = []
    for phase in (0.0, 1.0):
        torque = 0.45 * np.sin(2.0 * t + phase) + 0.35 * np.sin(5.3 * t)
        angle = _moved(torque, 200.0, 0.006, 0.01, 0.04, 0.48)
        rounded = 1.5e-3 * np.rint(angle / 1.5e-3)
        tables.append({"time_s": t, "current_A": torque, "angle_rad": rounded})
    return Machine("joint", plants.servo(0.005, 0.01, sampling_Hz=200.0), tuple(tables))


def stage() -> Machine:
    """A carriage with dry friction in open loop, 500 Hz."""
    t = np.arange(1500) / 500.0
    tables = []
    for phase in (0.0, 1.0):
        force = 60.0 * np.sin(3.0 * t + phase) + 20.0 * np.sin(11.0 * t)
        place = _moved(force, 500.0, 95.0, 200.0, 15.0, 0.0)
        noisy = place + 1e-5 * np.random.default_rng(round(phase)).standard_normal(t.size)
        tables.append({"time_s": t, "current_A": force, "angle_rad": noisy})
    return Machine("stage", plants.stage(95.0, 200.0, sampling_Hz=500.0), tuple(tables))


def process() -> Machine:
    """A plant of first order with a delay that its model lacks, 10 Hz."""
    t = np.arange(900) / 10.0
    tables = []
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        effort = np.repeat(rng.normal(0.0, 1.0, 18), 50)
        late = np.concatenate([np.zeros(8), effort[:-8]])
        output = np.zeros(t.size)
        for k in range(1, t.size):
            output[k] = output[k - 1] + (2.0 * late[k - 1] - output[k - 1]) / 30.0
        noisy = output + 0.01 * rng.standard_normal(t.size)
        tables.append({"time_s": t, "current_A": effort, "tension_N": noisy})
    model = plants.linear_plant(control.tf([2.0], [3.0, 1.0]), sampling_Hz=10.0)
    return Machine("process", model, tuple(tables))


def measured(data: Path) -> Iterator[Machine]:
    """The measured machines whose files are there."""
    models = {
        "servo_xl330": plants.servo(0.005, 0.01, sampling_Hz=187.0, encoder_counts=4096.0),
        "pendulum": plants.servo(0.14, 0.05, sampling_Hz=300.0),
        "winch_motor": plants.servo(
            2.5e-4, 1e-4, torque_constant_Nm_A=0.0094, encoder_counts=8192.0, sampling_Hz=430.0
        ),
    }
    for name, (files, columns) in MEASURED.items():
        paths = [data / name / f"{file}.csv" for file in files]
        if not all(path.is_file() for path in paths):
            continue
        read = [np.genfromtxt(path, delimiter=",", names=True)[:ROWS] for path in paths]
        tables = tuple({column: np.asarray(rows[column]) for column in columns} for rows in read)
        names = dict(zip(("time_s", "current_A", "angle_rad"), columns, strict=True))
        given = {full: own for full, own in names.items() if full != own}
        yield Machine(name, models[name], tables, AS_NAMED.with_options(given, {}, {}))


def _moved(effort: FloatArray, rate_Hz: float, *numbers: float) -> FloatArray:
    """Position of an inertia with viscous and dry friction and a link's gravity."""
    parts, (inertia, viscous, dry, link) = 20, numbers
    dt, place, speed, places = 1.0 / (parts * rate_Hz), 0.0, 0.0, np.empty(effort.size)
    for k, drive in enumerate(effort.tolist()):
        places[k] = place
        for _ in range(parts):
            speed += (drive - viscous * speed - link * np.sin(place)) / inertia * dt
            speed = float(np.sign(speed)) * max(abs(speed) - dry / inertia * dt, 0.0)
            place += speed * dt
    return places
