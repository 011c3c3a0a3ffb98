"""Is the diagnosis right, or honestly unknown, on drives whose simulator shares no code with it?

Command: `python -m experiments.independent_drives --seed0 3000`.
Target: of 40 cases none is wrong, and 80 % of the visible effects are named.

Each case is a drive of `drives.py` with nothing, one or two effects hidden, a model file with the
numbers its owner believes, and logs as `logs.py` writes them: units of their own, jittered or
rounded stamps, rounded angles, disturbances. They are diagnosed as the page on own records says.
A verdict is `right` if it names what is hidden and nothing else, `part` if it names only one of
two, `wrong` if it names what is not there, or `none` where something is hidden; `unknown`, and a
tie with what is hidden, are honest. Seeds are in `seeds.md`.
"""

import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import astuple
from pathlib import Path
from typing import NamedTuple

import numpy as np

import plants
from estune.errors import InvalidInput
from experiments.hidden_scores import Held
from experiments.hidden_tables import show_intervals
from experiments.independent_drives.drives import KINDS, UNDECLARED, draw
from experiments.independent_drives.logs import Logger
from experiments.results import Target, at_least, at_most, command_line, print_results
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.models.model_file import load_model

QUICK = (("link", 1), ("stage", 6))


class DriveCase(NamedTuple):
    """One diagnosis.

    Attributes:
        hidden: What is hidden.
        log: How the log was written.
        said: Verdict and names.
        judged: `right`, `part`, `unknown` or `wrong`.
        ratio: Prediction error of the model without effects, in noise floors.
        left: Of the model that is believed.
        held: Intervals of inertia, viscous friction and the sizes of effects that are there.
        cpu_s: CPU time of the diagnosis.
    """

    hidden: str
    log: str
    said: str
    judged: str
    ratio: float
    left: float
    held: tuple[Held, ...]
    cpu_s: float


def judge(hidden: tuple[str, ...], verdict: str, names: set[str], tied: set[str]) -> str:
    """What a verdict is worth."""
    known = set(hidden) - UNDECLARED
    if names - known:
        return "unknown" if verdict == "ambiguous" and known <= tied | names else "wrong"
    if names:
        return "right" if names == set(hidden) else "part"
    if verdict == "none":
        return "wrong" if hidden else "right"
    return "unknown"


def diagnose(kind: str, case: int, seed: int, folder: Path) -> DriveCase:
    """Draws a case, writes its files into a folder, and reads them as its owner would."""
    drive = draw(kind, case, seed)
    rng = np.random.default_rng([seed, case, 1, *kind.encode()])
    logger = Logger.drawn(kind, rng)
    logger.write(drive, folder, rng)
    begun = time.process_time()
    hidden = " + ".join(drive.hidden) or "nothing"
    log = " ".join(str(value) for value in logger)
    try:
        model = load_model(folder / "model.toml")
        found = plants.explain(model, folder / "logs", columns=logger.columns)
    except InvalidInput as error:
        nan = float("nan")
        return DriveCase(hidden, log, f"refused: {error}", "wrong", nan, nan, (), nan)
    names = {effect.name for effect in found.effects}
    said = f"{found.verdict} {' + '.join(sorted(names or found.ambiguous))}".strip()
    took = time.process_time() - begun
    judged = judge(drive.hidden, found.verdict, names, set(found.ambiguous))
    held = (*held_of_base(found, drive.numbers), *held_of_effects(found, drive.numbers))
    return DriveCase(hidden, log, said, judged, found.before.ratio, found.after.ratio, held, took)


SIZES = {
    "backlash": ("play_rad", "play"),
    "bent_viscous_friction": ("bend_Nms2", "quadratic"),
    "coulomb_friction": ("torque_Nm", "dry"),
    "current_lag": ("lag_s", "lag"),
    "current_saturation": ("limit_A", "limit"),
    "dead_time": ("delay_s", "dead_time"),
    "dahl_hysteresis": ("torque_Nm", "dry"),
    "link_gravity": ("torque_Nm", "gravity"),
    "stribeck_friction": ("coulomb_Nm", "dry"),
    "torque_ripple": ("amplitude_Nm", "ripple1"),
}
"""The size of an effect by the number of `drive.c` that it stands for.

Load friction has none: there it is a share of what the gear passes on, in the model of the motor's
torque.
"""


def held_of_effects(found: Diagnosis, numbers: Mapping[str, float]) -> Iterator[Held]:
    """Intervals of the sizes of effects that are there."""
    for effect in found.effects:
        parameter, number = SIZES.get(effect.name, ("", ""))
        at, true = effect.parameters.get(parameter), numbers.get(number, 0.0)
        if at is not None and true:
            yield Held(f"{effect.name}.{parameter}", true, at.value, at.low, at.high)


def held_of_base(found: Diagnosis, numbers: Mapping[str, float]) -> list[Held]:
    """Intervals of the base numbers."""
    inertia = numbers["inertia"] + numbers["load_inertia"]
    viscous = numbers["viscous"] + numbers["load_viscous"]
    true = {
        **dict.fromkeys(("inertia_kg_m2", "mass_kg"), inertia),
        **dict.fromkeys(("viscous_friction_Nms", "viscous_friction_Ns_m"), viscous),
    }
    own = {one.name: one.with_effects for one in found.calibrations}
    return [
        Held(name, value, own[name].value, own[name].low, own[name].high)
        for name, value in true.items()
        if name in own
    ]


def main() -> int:
    """Prints a line for each case, or with --json one object; returns 1 if a target is missed."""
    parser = command_line(__doc__, quick=f"{len(QUICK)} cases")
    parser.add_argument("--seed0", type=int, default=3000, help="seed of all cases")
    parser.add_argument(
        "--only", default="", help="kinds, and their cases, as link or link1,stage"
    )
    options = parser.parse_args()
    every = [(kind, n) for kind, one in KINDS.items() for n in range(len(one.hidden))]
    only = [one for one in options.only.split(",") if one]
    chosen = [(k, n) for k, n in every if not only or k in only or f"{k}{n}" in only]
    rows: dict[str, DriveCase] = {}
    for kind, n in QUICK if options.quick else chosen:
        with tempfile.TemporaryDirectory() as place:
            rows[f"{kind} {n}"] = one = diagnose(kind, n, options.seed0, Path(place))
        if not options.json:
            print(f"{kind} {n}: {one.judged}: {one.hidden}: {one.said}", flush=True)
    if not options.json:
        print()
        show_intervals([one for row in rows.values() for one in row.held])
    cases = {
        name: row._asdict() | {"held": [astuple(one) for one in row.held]}
        for name, row in rows.items()
    }
    return print_results(
        {"cases": cases},
        targets(list(rows.values())),
        as_json=options.json,
        tables=True,
    )


def targets(rows: list[DriveCase]) -> dict[str, Target]:
    """Targets of all cases."""
    without = ("nothing", *UNDECLARED)
    declared = [row for row in rows if not any(name in row.hidden for name in without)]
    named = [row.judged in ("right", "part") for row in declared]
    return {
        "independent_drives_wrong": at_most(sum(row.judged == "wrong" for row in rows), 0),
        **({"independent_drives_named": at_least(float(np.mean(named)), 0.8)} if named else {}),
    }


if __name__ == "__main__":
    raise SystemExit(main())
