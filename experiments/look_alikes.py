"""Which effects of the catalogue look like a given one, and at which records?

Command: `python -m experiments.look_alikes --effect module:Class`.
Target: another effect is never named without doubt where the right one is among the choices.

Records of a simulated machine with the effect are diagnosed twice: without the effect among the
choices, where what is named stands in for it, and with it, where what cannot be told from it makes
the verdict ambiguous. Each kind of record is tried alone, then all together.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import plants
from estune.core.quantities import FloatArray
from experiments.results import Target, at_most, command_line, print_results
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.effects import Effect, declared, find
from plants.models.reel import SAFE_GAINS
from plants.simulation.batch import simulate_drive
from plants.simulation.noise import NoiseSource
from plants.simulation.plant import TrialSetpoint

USUAL = ("bent_viscous_friction", "coulomb_friction")
"""Effects that are looked at where none is given."""
SECONDS = 4.0
TIMES = 3.0
"""Size of the effect, in times its usual one: far above the noise, so that its form shows."""


class ShownRecord(NamedTuple):
    """What one kind of record shows.

    Attributes:
        without: Verdict where the effect is not among the choices.
        stands_in: What is named in its place.
        explains: Share of the error power that the best other effect explains.
        best: That effect.
        with_it: Verdict where it is.
        named: What is named then.
        tied: What cannot be told from it.
    """

    without: str
    stands_in: str
    explains: float
    best: str
    with_it: str
    named: str
    tied: str


def excitations(rate_Hz: float) -> dict[str, FloatArray]:
    """Commands about zero of size one, by kind."""
    t = np.arange(round(SECONDS * rate_Hz)) / rate_Hz
    lines = np.arange(1.0, 30.0)
    phase = np.random.default_rng(1).uniform(0.0, 2.0 * math.pi, (lines.size, 1))
    noise = np.cos(2.0 * math.pi * np.outer(lines, t) + phase).T @ (1.0 / np.hypot(1.0, lines / 5))
    return {
        "slow reversals": 2.0 / math.pi * np.arcsin(np.sin(2.0 * math.pi * 0.6 * t)),
        "steps": np.repeat([0.0, 1.0, -1.0, 0.5, -0.5, 0.0], math.ceil(t.size / 6))[: t.size],
        "noise": noise / np.abs(noise).max(),
        "one way": 0.5 + 0.4 * np.sin(2.0 * math.pi * 1.5 * t),
    }


def record(model: Any, name: str, excitation: FloatArray, seed: int) -> MeasuredRecord:
    """An open-loop record of a model."""
    preload = float(getattr(model, "tension_N", 0.0))
    size = 0.4 * preload or 0.15 * min(model.force_limit_N, 100.0)
    setpoint = preload + size * excitation
    time = np.arange(setpoint.size) / model.sampling_Hz
    noise = None
    if model.noise_rms_N > 0.0:
        noise = NoiseSource(seed).draw(0, setpoint.size, model.noise_rms_N)
    drive = TrialSetpoint(time, setpoint, preload, open_loop=True)
    seen = simulate_drive(model, SAFE_GAINS, drive, noise, math.inf)
    has_cable = preload > 0.0
    return MeasuredRecord(
        name=f"{name} {seed}",
        rig="simulated",
        sampling_Hz=model.sampling_Hz,
        cable_length_m=model.cable_length_m if has_cable else None,
        preload_N=preload,
        loop="open",
        profile=name,
        time_s=time,
        setpoint_N=setpoint,
        tension_N=seen.tension_N if has_cable else None,
        angle_rad=seen.angle_rad,
    )


def usual(effect: type[Effect]) -> Effect:
    """The effect, its sizes some times the usual ones."""
    own = effect()
    sizes = {}
    for name, p in effect.parameters().items():
        if p.neutral is not None:
            value = p.neutral + TIMES * (getattr(own, name) - p.neutral)
            sizes[name] = min(max(value, p.low), p.high)
    return effect(**{name: getattr(own, name) for name in effect.parameters()} | sizes)


def seen(
    model: Any, effect: type[Effect], records: Sequence[MeasuredRecord], others: Sequence[Any]
) -> ShownRecord:
    """What records of the effect are taken for, without it and with it."""
    without = plants.explain(model, records, effects=[e for e in others if e is not effect])
    with_it = plants.explain(model, records, effects=[*others, effect])
    best = max(without.candidates, key=lambda c: c.closure if c.closure == c.closure else -1.0)
    return ShownRecord(
        without.verdict,
        " + ".join(e.name for e in without.effects) or "-",
        best.closure,
        best.name,
        with_it.verdict,
        " + ".join(e.name for e in with_it.effects) or "-",
        " or ".join(with_it.ambiguous) or "-",
    )


def look_alikes(effect: type[Effect], model: Any, kinds: Sequence[str]) -> dict[str, ShownRecord]:
    """What each kind of record, and all together, shows of the effect."""
    waves = excitations(model.sampling_Hz)
    machine = model + usual(effect)
    taken = {kind: [record(machine, kind, waves[kind], seed) for seed in (1, 2)] for kind in kinds}
    others = [e for e in declared() if e is not effect]
    found = {kind: seen(model, effect, records, others) for kind, records in taken.items()}
    if len(taken) > 1:
        together = [one for records in taken.values() for one in records]
        found["all together"] = seen(model, effect, together, others)
    return found


def main() -> int:
    """Prints a table for each effect, or with --json one object."""
    parser = command_line(__doc__, quick="one effect, one kind of record")
    parser.add_argument("--effect", action="append", help="slug or module:Class; may be repeated")
    parser.add_argument("--reel", action="store_true", help="on a reel; else on a bare drive")
    options = parser.parse_args()
    model = plants.reference_reel() if options.reel else plants.unloaded_reel(dead_time_s=0.0)
    kinds = ["slow reversals"] if options.quick else list(excitations(model.sampling_Hz))
    chosen = [find(name) for name in options.effect or USUAL[: 1 if options.quick else None]]
    figures: dict[str, Any] = {}
    mistaken = 0
    for effect in chosen:
        found = look_alikes(effect, model, kinds)
        figures[effect.name] = {kind: one._asdict() for kind, one in found.items()}
        mistaken += sum(_is_mistaken(one, effect) for one in found.values())
    targets: dict[str, Target] = {"look_alikes_named": at_most(float(mistaken), 0.0)}
    return print_results(figures, targets, as_json=options.json, tables=True)


def _is_mistaken(one: ShownRecord, effect: type[Effect]) -> bool:
    """Whether another effect is named without doubt although the right one is a choice."""
    named = [find(name) for name in one.named.split(" + ") if name != "-"]
    families = {e.family or e.name for e in named}
    own = effect.family or effect.name
    return one.with_it in ("named", "incomplete") and own not in families


if __name__ == "__main__":
    raise SystemExit(main())
