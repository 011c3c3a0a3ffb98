"""Is a loop with friction fed forward as calm, as good and as well predicted as it must be?

Command: `python -m experiments.remedies`.
Target: rest at most 1.2 times that without; 80 % of what friction spoils in slow tracking removed
for Coulomb and load friction, 65 % for Stribeck and Dahl; tracking predicted within 0.05 on 95 %
and cost within 5 % on 90 % of drawn machines; no machine of another friction above 1.02. On the
emulated reel with Coulomb friction, from a diagnosis to a proven patch by one command in less than
3 minutes of the rig's time; ended there in a trial with the remedy, in one without and in the
tuning, the rig is as it was.

Machines are drawn about the reference reel: inertia, cable, viscous friction and the friction's
size within a factor of 1.5. What is told of the friction is its true numbers with an error of 5 %,
and an interval of 10 %, as a diagnosis gives them; no diagnosis is run here. The model that
predicts has the reference reel's other numbers, not the machine's. Seeds 1 to 100 are for
development; 9101 to 9200 and 9201 to 9300 were run once each, when all constants stood
(`--first 9101`, `--first 9201`).
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import plants
from estune import cli
from estune.core.gains import Gains
from estune.hardware import HardwareRig
from estune.proof.patch import read_patch
from estune.remote import zenoh
from estune.run.results.export import write_record
from estune.support.plot_style import BLUE, GREY, VERMILION, finish, legend, stacked, to_png
from estune.trial import TrialRecord, TrialRequest
from estune.trial.profiles import MultisineProfile, Profile, StepProfile, TriangleProfile
from estune.trial.tracking import tracking_profile
from experiments.compensation import rig
from experiments.results import at_least, at_most, command_line, print_results
from plants.diagnosis.interval import Interval
from plants.diagnosis.result import NamedEffect
from plants.effects import CoulombFriction, DahlHysteresis, Effect, LoadFriction, StribeckFriction
from plants.remedies import offers_for
from plants.remedies.behaviour import MEASURES, behaviour
from plants.simulation.compensation import compensation_of

GAINS = Gains(0.78, 31.0, 0.0206, 0.0003)
FRACTIONS = 0.4, 0.8, 1.0, 1.2
RATES_Hz = 250.0, 632.0, 1000.0
SPREAD = 1.5
TOLD_ERROR, TOLD_HALF = 0.05, 0.1
LAWS: dict[str, tuple[Effect, ...]] = {
    "Coulomb": tuple(CoulombFriction(size) for size in (0.01, 0.02, 0.05, 0.08)),
    "load": (LoadFriction(0.06), LoadFriction(0.12)),
    "Stribeck": (StribeckFriction(0.04, 0.03), StribeckFriction(0.02, 0.01)),
    "Dahl": (DahlHysteresis(0.05, 4e-3), DahlHysteresis(0.02, 2e-3)),
    "bristles": (DahlHysteresis(0.05, 4e-3, spread=4.0),),
}
REMOVED = {"Coulomb": 0.8, "load": 0.8, "Stribeck": 0.65, "Dahl": 0.65, "bristles": 0.65}
LOOKED: tuple[Profile, ...] = (
    StepProfile(15.0, 10.0, 0.2, 1.5),
    TriangleProfile(20.0, 12.0, period_s=3.0, start_s=0.2, duration_s=6.4, loop="open"),
    TriangleProfile(20.0, 8.0, period_s=2.0, start_s=0.2, duration_s=4.4),
    MultisineProfile(
        20.0, 3.0, period_s=1.0, first_line=1, last_line=60, duration_s=4.0, loop="open"
    ),
    StepProfile(20.0, 8.0, 0.2, 1.5, loop="open"),
)
"""Records by which the emulated reel is diagnosed, as those of the notebook."""
ENDED_IN = 1, 3, 4, 9
"""Trials in which a proof is killed: one without the remedy, step and triangle with it, and one of
the tuning."""
TOLD_AS_COULOMB = StribeckFriction(0.04, 0.02), DahlHysteresis(0.05, 1e-3, spread=4.0)
"""Frictions that are told as Coulomb friction of their size at speed."""


@dataclass(frozen=True)
class ToldDiagnosis:
    """What a diagnosis says of one effect, as far as remedies ask."""

    effects: tuple[NamedEffect, ...]
    augmented: Any
    calibrations: tuple[Any, ...] = ()
    noise: Any = None


def told(effect: Effect) -> ToldDiagnosis:
    """The diagnosis of an effect: its numbers, with intervals."""
    fitted = {
        name: Interval(value, value * (1.0 - TOLD_HALF), value * (1.0 + TOLD_HALF), p.unit)
        for name, p in effect.parameters().items()
        for value in [float(getattr(effect, name))]
    }
    named = NamedEffect(effect.name, effect.title, fitted, "", effect)
    return ToldDiagnosis((named,), plants.reference_reel() + effect)


def measured(reel: Any, table: Any = None) -> dict[str, float]:
    """The measures of a reel's loop, with a table of friction fed forward or without."""
    settling_s = plants.reference_reel().describe("reel", GAINS).settling_time_s
    remedy = compensation_of({"friction": table} if table else {}, reel.scale, reel.controller)
    return dict(zip(MEASURES, behaviour(reel, GAINS, settling_s, remedy).tolist(), strict=True))


@cache
def offered(effect: Effect) -> dict[str, float]:
    """The table that a diagnosis of the true numbers gives."""
    (offer,) = offers_for(told(effect), GAINS)
    return dict(offer.tables["friction"])


def fed(effect: Effect, fraction: float) -> dict[str, float]:
    """The same at a fraction."""
    return {**offered(effect), "fraction": fraction}


def by_law(*, quick: bool) -> dict[str, dict[str, float]]:
    """Rest and removed share of each law; the worst of its sizes, fractions and rates."""
    base = plants.reference_reel()
    free = measured(base)["tracking"]
    found = {}
    for law, effects in LAWS.items():
        rests, removed = [], []
        for effect in effects[-1:] if quick else effects:
            for rate in (632.0,) if quick else RATES_Hz:
                reel = replace(base, sampling_Hz=rate) + effect
                off = measured(reel)
                tables = [fed(effect, one) for one in ((0.8, 1.2) if quick else FRACTIONS)]
                rests += [measured(reel, table)["rest"] / off["rest"] for table in tables]
            off = measured(base + effect)
            on = measured(base + effect, fed(effect, 0.8))
            removed.append((off["tracking"] - on["tracking"]) / (off["tracking"] - free))
        found[law] = {"rest_ratio": max(rests), "removed": float(np.mean(removed))}
    return found


def drawn(seeds: range) -> Iterator[tuple[Any, Effect, Effect]]:
    """Machines: the reel without friction, its friction, and what is told of it."""
    base = plants.reference_reel()
    laws = [effects[0] for law, effects in LAWS.items() if law != "bristles"]
    for seed in seeds:
        random = np.random.default_rng(seed)

        def near(value: float, random: Any = random) -> float:
            return float(value * SPREAD ** random.uniform(-1.0, 1.0))

        reel = replace(
            base,
            drum_inertia_kg_m2=near(base.drum_inertia_kg_m2),
            cable_EA_N=near(base.cable_EA_N),
            viscous_friction_Nms=near(base.viscous_friction_Nms),
        )
        law = laws[seed % len(laws)]
        size = next(iter(law.parameters()))
        sizes = {n: near(getattr(law, n)) for n in ("torque_Nm", "load_share") if hasattr(law, n)}
        true = replace(law, **(sizes or {size: near(getattr(law, size))}))
        error = 1.0 + TOLD_ERROR * float(random.standard_normal())
        wrong = {n: getattr(true, n) * error for n in (sizes or {size: 0.0})}
        yield reel, true, replace(true, **wrong)


def predictions(seeds: range) -> dict[str, list[float]]:
    """Errors of the predicted ratios, and achieved ratios, of drawn machines."""
    found: dict[str, list[float]] = {"tracking": [], "cost": [], "achieved": [], "reversal": []}
    for reel, true, said in drawn(seeds):
        (offer,) = offers_for(told(said), GAINS)
        if not offer.worth:
            continue
        off, on = measured(reel + true), measured(reel + true, offer.tables["friction"])
        for name in ("tracking", "cost", "reversal"):
            found[name].append(offer.ratios[name].value - on[name] / off[name])
        found["achieved"].append(on["tracking"] / off["tracking"])
    return found


def another_law() -> list[float]:
    """Achieved ratios of tracking where the friction is not the one told."""
    ratios = []
    for true in TOLD_AS_COULOMB:
        size = getattr(true, "coulomb_Nm", getattr(true, "torque_Nm", 0.0))
        table = fed(CoulombFriction(size), 0.8)
        reel = plants.reference_reel() + true
        ratios.append(measured(reel, table)["tracking"] / measured(reel)["tracking"])
    return ratios


class Watched:
    """A rig that counts its trials, and calls before one of them begins."""

    def __init__(self, rig: HardwareRig, number: int, call: Callable[[], None]) -> None:
        self._rig, self._left, self._call = rig, number, call

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs a trial."""
        self._left -= 1
        if not self._left:
            self._call()
        return self._rig.run(request)


def emulated_diagnosis(folder: Path) -> Path:
    """The diagnosis of five records of the emulated reel, JSON."""
    with emulated() as reel:
        for number, profile in enumerate(LOOKED):
            write_record(reel.run(TrialRequest("look", number, GAINS, profile)), folder)
    found = plants.explain(plants.reference_reel(), folder)
    path = folder / "diagnosis.json"
    path.write_text(json.dumps(found.to_json()))
    return path


def emulated() -> HardwareRig:
    """The emulated reel with Coulomb friction, at `GAINS`."""
    reel = rig({}, friction={"name": "coulomb_friction", "torque_Nm": 0.05})
    reel.apply(GAINS)
    return reel


def proven_on_the_rig(diagnosis: Path) -> dict[str, Any]:
    """The proof of a diagnosis' remedy on the emulated reel: sentence, and the rig's time, s."""
    ledger = diagnosis.with_name("ledger")
    with emulated() as reel, zenoh.serve(reel, "tcp/127.0.0.1:0", ledger=ledger) as server:
        began = reel.timing().samples
        code = cli.run(["prove", str(diagnosis), server.endpoint, "--yes"])
        rig_s = (reel.timing().samples - began) / reel.describe().controller.sampling_Hz
    proof = read_patch(diagnosis.with_name("coulomb_friction.remedy.json")).proof
    return {"proven": float(code == 0), "rig_s": rig_s, "sentence": proof and proof["sentence"]}


def ended_in(diagnosis: Path, number: int) -> bool:
    """Whether the rig is as it was after the command was killed in a trial."""
    children: list[subprocess.Popen[bytes]] = []
    with emulated() as reel:
        watched: Any = Watched(reel, number, lambda: children[0].kill())  # noqa: PLW0108
        before = reel.describe()
        ledger = diagnosis.with_name(f"ledger-{number}")
        with zenoh.serve(watched, "tcp/127.0.0.1:0", ledger=ledger) as server:
            words = ["prove", str(diagnosis), server.endpoint, "--yes"]
            child = subprocess.Popen([sys.executable, "-m", "estune", *words])  # noqa: S603
            children.append(child)
            killed = children[0].wait() < 0
        record = reel.run(TrialRequest("after", 0, before.gains, before.step))
        return killed and reel.describe() == before and not record.optional_columns


def draw(folder: Path) -> None:
    """The tension on a slow triangle with Coulomb friction, without the remedy and with it."""
    friction = CoulombFriction(0.05)
    reel = plants.reference_reel() + friction
    settling_s = reel.describe("reel", GAINS).settling_time_s
    profile = tracking_profile(reel.profile, settling_s)
    table = json.dumps({"friction": fed(friction, 0.8)})
    machine = reel.rig(gains=GAINS)
    figure, (tension, error) = stacked(2, 4.2)
    for number, (name, text) in enumerate((("without", ""), ("friction fed forward", table))):
        record = machine.run(TrialRequest("draw", number, GAINS, profile, compensation=text))
        color = BLUE if text else VERMILION
        if not text:
            tension.plot(record.time_s, record.setpoint_N, color=GREY, label="setpoint")
        tension.plot(record.time_s, record.tension_N, color=color, linewidth=0.9, label=name)
        error_N = record.setpoint_N - record.tension_N
        error.plot(record.time_s, error_N, color=color, linewidth=0.7)
    machine.close()
    finish(tension, "tension (N)")
    finish(error, "error (N)", "time (s)")
    legend(tension)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "remedies.png").write_bytes(to_png(figure))


def main() -> int:
    """Measures and prints; returns 1 where a target is missed."""
    short = "one size, two fractions, one rate, eight machines"
    parser = command_line(__doc__, quick=short, out="the figure")
    parser.add_argument("--first", type=int, default=1, help="first seed of the drawn machines")
    arguments = parser.parse_args()
    count = 8 if arguments.quick else 100
    laws = by_law(quick=arguments.quick)
    errors = predictions(range(arguments.first, arguments.first + count))
    tracking, cost = (np.abs(errors[name]) for name in ("tracking", "cost"))
    others = another_law()
    draw(arguments.out)
    on_the_rig, as_it_was = {}, []
    if not arguments.quick:
        with tempfile.TemporaryDirectory() as folder:
            diagnosis = emulated_diagnosis(Path(folder))
            as_it_was = [ended_in(diagnosis, number) for number in ENDED_IN]
            on_the_rig = proven_on_the_rig(diagnosis)
    figures = {
        "on_the_emulated_reel": on_the_rig,
        "laws": laws,
        "machines_with_an_offer": len(tracking),
        "tracking_achieved_median": float(np.median(errors["achieved"])),
        "reversal_predicted_less_achieved_mean": float(np.mean(errors["reversal"])),
    }
    targets = {
        "rest_ratio_max": at_most(max(one["rest_ratio"] for one in laws.values()), 1.2),
        **{f"removed_{law}": at_least(laws[law]["removed"], at) for law, at in REMOVED.items()},
        "tracking_within_0.05": at_least(float(np.mean(tracking <= 0.05)), 0.95),
        "cost_within_5_percent": at_least(float(np.mean(cost <= 0.05)), 0.9),
        "worst_achieved": at_most(max(errors["achieved"]), 1.02),
        "another_law_worst": at_most(max(others), 1.02),
    }
    if on_the_rig:
        targets["proven_on_the_rig"] = at_least(on_the_rig["proven"], 1.0)
        targets["rig_s"] = at_most(on_the_rig["rig_s"], 180.0)
        targets["as_it_was_where_ended"] = at_least(float(np.mean(as_it_was)), 1.0)
    return print_results(figures, targets, as_json=arguments.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
