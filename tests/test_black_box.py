"""Black box of a rig: its motion and commands on disk, copied at stops, read as a record."""

import json
import time
from contextlib import contextmanager

import numpy as np
import pytest

from estune.cli.rig_metrics import rig_metrics
from estune.core.gains import Gains
from estune.errors import RigError
from estune.hardware import HardwareRig
from estune.hardware.black_box import AFTER_S, BlackBox, black_box
from estune.hardware.shared_memory import MotionPhase
from estune.hardware.tables import BlackBoxTable
from estune.recordings.black_box_file import ROW, read_file
from estune.recordings.readers.black_box import sampling_instants
from estune.remote import zenoh
from estune.trial import GUARD, Outcome, TrialRequest
from plants.diagnosis.data.records import read_measurements
from tests.support_hardware import quick
from tests.support_rigs import description

RATE = 632.0
TABLE = BlackBoxTable(minutes=0.02, stops_kept=2)


class RowsRig:
    """A rig whose motion the test writes."""

    stop_reason = "tension 61 N; limit 60 N"

    def __init__(self) -> None:
        self.rows = np.zeros(0, ROW)

    def describe(self):
        return description()

    def move(self, count: int, phase=MotionPhase.HOLD, flags=0) -> None:
        rows = np.zeros(count, ROW)
        rows["sample"] = self.rows.size + 1 + np.arange(count)
        rows["time_s"], rows["tension_N"] = rows["sample"] / RATE, rows["sample"]
        rows["phase"], rows["flags"][-1:] = phase, flags
        self.rows = np.concatenate([self.rows, rows])

    def motion_since(self, sample):
        return self.rows[sample:]


@contextmanager
def visited(rig, folder, table=TABLE):
    """A box that the test visits, in place of its thread."""
    box = BlackBox(rig, folder, table)
    box._closing.set()
    box._thread.join()
    box._closing.clear()
    yield box
    box.close()


def stops(folder) -> list:
    return sorted(folder.glob("stop-*.blackbox"))


def reason(path) -> str:
    return json.loads(path.with_suffix(".json").read_text())["reason"]


def test_box_keeps_the_last_minutes_of_powered_motion_in_order(tmp_path):
    rig = RowsRig()
    with visited(rig, tmp_path) as box:
        for count, phase in ((500, MotionPhase.TRIAL), (40, MotionPhase.OFF), (900, 2), (3, 2)):
            rig.move(count, phase)
            box._visit()
        kept = read_file(tmp_path / "motion.blackbox").rows["sample"]
    rate = rig.describe().controller.sampling_Hz
    powered = np.r_[1:501, 541:1444]
    assert np.array_equal(kept, powered[-round(60.0 * TABLE.minutes * rate) :])


def test_stop_is_copied_with_its_reason_the_commands_and_what_follows(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.hardware.black_box.AFTER_S", 0.0)
    rig = RowsRig()
    with visited(rig, tmp_path) as box:
        box.hear("submit", b'{"request": 1}', b'{"verdict": "accepted"}')
        box.hear("lease", b'{"action":"renew"}', b"{}")
        rig.move(50, flags=GUARD)
        box._visit()
        (stop,) = stops(tmp_path)
        assert reason(stop) == rig.stop_reason
        (command,) = json.loads(stop.with_suffix(".json").read_text())["commands"]
        assert (command["verb"], command["command"]) == ("submit", {"request": 1})
        assert read_file(stop).rows.size == 50
        for number in range(3):
            box.hear("estop", json.dumps({"reason": str(number)}).encode(), b"{}")
            box._visit()
        assert [reason(path) for path in stops(tmp_path)] == [
            f"emergency stop: {number}" for number in (1, 2)
        ]
        assert box.stops == 4
    assert AFTER_S > 1.0


def test_program_that_was_killed_leaves_its_motion_as_a_stop(tmp_path):
    rig = RowsRig()
    with visited(rig, tmp_path) as killed:
        rig.move(30)
        killed._visit()
        at_the_kill = (tmp_path / "motion.blackbox").read_bytes()
    (tmp_path / "motion.blackbox").write_bytes(at_the_kill)
    with visited(RowsRig(), tmp_path):
        (stop,) = stops(tmp_path)
        assert "killed" in reason(stop)
        assert read_file(stop).rows.size == 30
    with visited(RowsRig(), tmp_path):
        assert len(stops(tmp_path)) == 1  # the one before has ended in order


def test_full_disk_costs_the_box_and_is_logged_once(tmp_path, monkeypatch, caplog):
    rig = RowsRig()
    with visited(rig, tmp_path) as box:

        def full(*_):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr("estune.hardware.black_box.os.pwrite", full)
            for _ in range(3):
                rig.move(10)
                box._visit()
        assert caplog.text.count("No space left") == 1
        rig.move(10)
        box._visit()
        assert read_file(tmp_path / "motion.blackbox").rows["sample"][-1] == 40


def test_folder_that_cannot_be_written_is_named_with_a_remedy(tmp_path):
    (tmp_path / "rig-blackbox").touch()
    with (
        pytest.raises(RigError, match=r"rig-blackbox: File exists; .* minutes = 0"),
        black_box(RowsRig(), tmp_path / "rig.toml", BlackBoxTable()),
    ):
        pass
    with black_box(RowsRig(), tmp_path / "rig.toml", BlackBoxTable(minutes=0.0)) as box:
        assert box is None


def test_skipped_instants_are_found_behind_any_lateness():
    rng, count = np.random.default_rng(3), np.arange(20_001)
    is_late = count % 7 == 0  # never the last one before a skip
    skipped = (rng.random(count.size) < 0.05) & ~np.roll(is_late, 1)
    true = np.cumsum(1 + skipped * rng.integers(1, 40, count.size))
    late = np.where(is_late, 0.95, 0.2 * rng.random(count.size))
    instants = sampling_instants((true + late) / RATE + 1e5, RATE)
    assert np.array_equal(instants, true - true[0])


@pytest.mark.slow
def test_stop_of_a_served_rig_is_a_record_of_its_motion(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.hardware.black_box.AFTER_S", 0.2)
    config = quick(step__duration_s=2.0)
    with (
        HardwareRig(config) as rig,
        black_box(rig, tmp_path / "rig.toml", BlackBoxTable()) as box,
        rig_metrics(rig, box, 0) as metrics,
        zenoh.serve(rig, ledger=tmp_path / "ledger", heard=metrics.hear) as server,
        zenoh.connect(server.endpoint) as remote,
    ):
        step, live = remote.describe().step, remote.describe().gains
        unstable = Gains(12.0, 600.0, 0.015, 0.005)
        trials = [TrialRequest("run", n, g, step) for n, g in enumerate((live, unstable))]
        records = [remote.run(trial) for trial in trials]
        assert [r.outcome for r in records] == [Outcome.DONE, Outcome.GUARD]
        ends = time.monotonic() + 20.0
        while not box.stops and time.monotonic() < ends:
            time.sleep(0.05)
        samples = {
            (s.name, s.labels.get("verb")): s.value for f in metrics.collect() for s in f.samples
        }
        assert samples["estune_rig_commands_total", "submit"] == 2.0
        assert samples["estune_rig_stops_total", None] == 1.0
        assert samples["estune_rig_samples_total", None] > records[0].time_s.size
        assert metrics.fault() == ""
    assert "closed" in metrics.fault()
    (stop,) = stops(tmp_path / "rig-blackbox")
    assert reason(stop) == records[1].reason
    tension = records[1].tension_N
    rows = read_file(stop).rows
    (first,) = np.flatnonzero(rows["tension_N"] == tension[0])[-1:]
    assert np.array_equal(rows["tension_N"][first : first + tension.size], tension)
    for measured in read_measurements(stop).measurements:
        assert measured.sampling_Hz == config.sampling_Hz
        assert measured.gains == live
