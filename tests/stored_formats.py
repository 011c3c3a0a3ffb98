"""Writes one of each stored format into tests/assets/stored/VERSION: run once before a release.

./dev python -m tests.stored_formats

The files of earlier versions stay as they are: tests/test_stored_formats.py opens all of them.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import estune
import plants
from estune.core.schedule import GainCurve, GainSchedule
from estune.remote import zenoh
from estune.studies.sweep.sweep import sweep
from plants.emulator import RIG_FILE
from plants.models import model_file
from tests.support_daemon import Plant, daemon, rig_table
from tests.support_rigs import ScriptedRig
from tests.support_runs import ArithmeticRig

ROOT = Path(__file__).parent / "assets" / "stored"
DESIGN = {
    "lengths_m": [0.5, 0.8],
    "rigs": ["plants:reference_reel"],
    "tuners": ["least_squares_gradient"],
    "trials": 5,
    "repeats": 2,
}
SCHEDULE = GainSchedule(
    P=GainCurve("constant", 1.2),
    I=GainCurve("linear", 70.0, -20.0),
    D=GainCurve("constant", 0.02),
    setpoint_filter_s=GainCurve("constant", 0.01),
    length_m=(0.5, 1.4),
    tension_N=(15.0, 15.0),
)
MODEL = replace(plants.reference_reel(), tension_N=16.0) + plants.effects.CoulombFriction(0.2)


def write(folder: Path) -> None:
    """Writes the files."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    # A tuner whose proposals are those of a paper, and stay.
    estune.tune(ArithmeticRig(), tuner="otis", trials=6, folder=folder, run="run", watch=None)
    sweep(DESIGN, folder=folder / "sweep", watch=None, jobs=1)
    shutil.copy(RIG_FILE, folder / "rig.toml")
    model_file.save_model(MODEL, folder / "model.toml")
    (folder / "schedule.json").write_text(json.dumps(SCHEDULE.as_dict(), indent=2) + "\n")
    with (
        zenoh.serve(ScriptedRig(Plant(), name="drum"), ledger=folder / "rig.ledger") as server,
        daemon(folder / "daemon", rig_table("drum", server.endpoint, trials=6)) as it,
    ):
        it.until_mode("holding", "drum")
    for file in (*folder.rglob("*.html"), *folder.rglob("*.lock"), *folder.rglob("*.png")):
        file.unlink()


if __name__ == "__main__":
    write(ROOT / estune.__version__)
