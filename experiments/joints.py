"""Which law of a joint is named at which rate of its log and resolution of its encoder?

Command: `python -m experiments.joints --seed 1`.
Target: of 20 joints with Coulomb friction 20 are named, of each other law at least 18.

Joints that follow two sines by a loop of their own, drawn at random and integrated here by small
steps in which dry friction stops them, sharing no code with the models. Logs are of 25 to 1000 Hz,
encoders of 10 to 16 bits; the loop holds its torque from one row to the next. Owners know inertia
and viscous friction to 10 and 30 %, or, with `--off`, the inertia by another factor. Seed 1 is
development.
"""

import time
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

import plants
from estune.core.quantities import FloatArray
from experiments.results import at_least, at_most, command_line, print_results
from plants.diagnosis.data.measured_record import MeasuredRecord

RATES_Hz, BITS = (25.0, 50.0, 100.0, 200.0, 1000.0), (10, 12, 14, 16)
SECONDS, FINE_Hz = 20.0, 4000.0
LAWS = {
    "coulomb": "coulomb_friction",
    "stribeck": "stribeck_friction",
    "load": "load_friction",
    "gravity": "link_gravity",
}


class DrawnJoint(NamedTuple):
    """A joint with one law; torques in N m.

    Attributes:
        inertia: Inertia, kg m2.
        viscous: Viscous friction, N m s/rad.
        dry: Dry friction.
        excess: What is added to it at rest.
        fading: Velocity over which that fades, rad/s.
        share: Friction per torque of the motor.
        weight: Greatest torque of gravity.
        lean: Angle at which gravity is none, rad.
        reference: What it follows: two amplitudes, rad, two frequencies, rad/s, and a phase.
    """

    inertia: float
    viscous: float
    dry: float
    excess: float
    fading: float
    share: float
    weight: float
    lean: float
    reference: tuple[float, float, float, float, float]

    @classmethod
    def drawn(cls, law: str, rng: np.random.Generator) -> "DrawnJoint":
        """A joint by chance: its inertia takes about as much torque as its viscous friction."""
        inertia = float(np.exp(rng.uniform(np.log(1e-4), np.log(1.0))))
        slow, fast = rng.uniform(0.8, 1.5), rng.uniform(2.5, 4.0)
        wide, narrow = rng.uniform(0.8, 1.5), rng.uniform(0.3, 0.6)
        speed = float(np.hypot(wide * slow, narrow * fast))
        viscous = inertia * rng.uniform(1.0, 4.0)
        effort = inertia * np.hypot(wide * slow**2, narrow * fast**2) + viscous * speed
        dry = effort * rng.uniform(0.1, 0.3) if law in ("coulomb", "stribeck") else 0.0
        return cls(
            inertia=inertia,
            viscous=float(viscous),
            dry=float(dry),
            excess=float(dry * rng.uniform(0.4, 0.9)) if law == "stribeck" else 0.0,
            fading=float(speed * rng.uniform(0.05, 0.2)),
            share=float(rng.uniform(0.08, 0.3)) if law == "load" else 0.0,
            weight=float(effort * rng.uniform(0.4, 1.2)) if law == "gravity" else 0.0,
            lean=float(rng.uniform(-3.0, 3.0)),
            reference=(wide, narrow, slow, fast, float(rng.uniform(0.0, 6.0))),
        )

    def run(self, rate_Hz: float) -> tuple[FloatArray, FloatArray]:
        """Angle and held torque at each row of a log, shape (rows,)."""
        band = 2.0 * np.pi * min(3.0, rate_Hz / 12.0)
        stiff, damping = self.inertia * band**2, 1.4 * self.inertia * band
        t = np.arange(round(SECONDS * rate_Hz)) / rate_Hz
        wide, narrow, slow, fast, phase = self.reference
        wanted = wide * np.sin(slow * t) + narrow * np.sin(fast * t + phase)
        to = zip(wanted.tolist(), np.gradient(wanted, 1.0 / rate_Hz).tolist(), strict=True)
        h, q, v = 1.0 / FINE_Hz, float(wanted[0]), 0.0
        angle, torque = np.empty((2, t.size))
        for n, (place, speed) in enumerate(to):
            held = stiff * (place - q) + damping * (speed - v)
            angle[n], torque[n] = q, held
            for _ in range(round(FINE_Hz / rate_Hz)):
                stops = self.dry + self.share * abs(held)
                if self.excess:
                    stops += self.excess * float(np.exp(-((v / self.fading) ** 2)))
                smooth = held - self.viscous * v
                if self.weight:
                    smooth -= self.weight * float(np.sin(q - self.lean))
                free = v + h * smooth / self.inertia
                v = float(np.sign(free)) * max(abs(free) - h * stops / self.inertia, 0.0)
                q += h * v
        return angle, torque


class JointCase(NamedTuple):
    """What a diagnosis says of one joint."""

    law: str
    rate_Hz: float
    bits: int
    said: str
    right: bool
    wrong: bool
    cpu_s: float
    sentence: str


def diagnose(law: str, rate_Hz: float, bits: int, seed: int, off: float) -> JointCase:
    """The diagnosis of one joint."""
    rng = np.random.default_rng([seed, [*LAWS].index(law), round(rate_Hz), bits])
    joint = DrawnJoint.drawn(law, rng)
    angle, torque = joint.run(rate_Hz)
    step = 2.0 * np.pi / 2**bits
    record = MeasuredRecord(
        name="joint",
        rig="arm",
        sampling_Hz=rate_Hz,
        loop="closed",
        time_s=np.arange(torque.size) / rate_Hz,
        current_A=torque,
        angle_rad=np.round(angle / step) * step,
    )
    inertia = joint.inertia * (off or rng.uniform(0.9, 1.1))
    model = plants.servo(inertia, joint.viscous * rng.uniform(0.7, 1.3), sampling_Hz=rate_Hz)
    begun = time.process_time()
    found = plants.explain(model, [record])
    names = {effect.name for effect in found.effects}
    said = f"{found.verdict} {' + '.join(sorted(names))}".strip()
    return JointCase(
        *(law, rate_Hz, bits, said),
        right=names == {LAWS[law]} and found.verdict in ("named", "incomplete"),
        wrong=bool(names - {LAWS[law]}) and found.verdict != "ambiguous",
        cpu_s=time.process_time() - begun,
        sentence=found.sentence,
    )


def figures_of(cases: list[JointCase]) -> Mapping[str, int]:
    """Right names of each law, and wrong ones of all."""
    right = {law: [c.right for c in cases if c.law == law] for law in LAWS}
    return {f"{law}_named": sum(each) for law, each in right.items() if each} | {
        "wrong": sum(case.wrong for case in cases)
    }


def main() -> int:
    """Prints a line for each joint, or with --json one object; returns 1 if a target is missed."""
    parser = command_line(__doc__, quick="Coulomb friction at 100 Hz alone")
    parser.add_argument("--seed", type=int, default=1, help="seed of all joints")
    parser.add_argument("--off", type=float, default=0.0, help="inertia believed per true one")
    parser.add_argument("--laws", default=",".join(LAWS), help=f"some of {', '.join(LAWS)}")
    options = parser.parse_args()
    wanted = ["coulomb"] if options.quick else options.laws.split(",")
    grid = [(r, b) for r in RATES_Hz for b in BITS if not options.quick or r == 100.0]
    cases = []
    for law in wanted:
        for rate_Hz, bits in grid:
            cases.append(diagnose(law, rate_Hz, bits, options.seed, options.off))
            if not options.json:
                last = cases[-1]
                row = f"{law:9} {rate_Hz:5g} Hz {bits} bit  {last.cpu_s:5.1f} s  {last.said}"
                print(row, flush=True)
    figures = figures_of(cases)
    targets = {
        f"{law}_named": at_least(
            figures[f"{law}_named"],
            len(grid) if law == "coulomb" else 0.9 * len(grid),
        )
        for law in wanted
    }
    targets["wrong"] = at_most(figures["wrong"], 0)
    named = {f"{c.law} {c.rate_Hz:g} Hz {c.bits} bit": c._asdict() for c in cases}
    return print_results({**figures, "joints": named}, targets, as_json=options.json, tables=False)


if __name__ == "__main__":
    raise SystemExit(main())
