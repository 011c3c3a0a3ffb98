"""What the owner of a drive has: a model file, and logs as such machines write them."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.recordings.column_map import ColumnMap
from experiments.independent_drives.drives import KINDS, Column, DriveInputs, IndependentDrive, run

SECONDS = (14.0, 10.0)
"""Length of the records."""
SOFT_START_s = 1.0
"""Time in which a motion from rest is begun."""


class Logger(NamedTuple):
    """How a drive's log is written.

    Attributes:
        step: Step of the encoder, rad or m.
        clock: `even`, `jittered` or `rounded` stamps.
        torque_unit: Unit of the column of the command.
        angle_unit: Unit of the column of the position.
        moving: Whether the records begin in motion.
        disturbed: Coloured disturbance, relative to the rms command.
        noisy: Coloured noise of the command as it is logged, relative to its rms.
    """

    step: float
    clock: str
    torque_unit: str
    angle_unit: str
    moving: bool
    disturbed: float
    noisy: float

    @classmethod
    def drawn(cls, kind: str, rng: np.random.Generator) -> "Logger":
        """A logger by chance."""
        linear = kind == "stage"
        return cls(
            step=float(rng.choice(KINDS[kind].steps)),
            clock=str(rng.choice(["even", "jittered", "rounded"])),
            torque_unit=str(rng.choice(["N", "kN"] if linear else ["Nm", "mNm"])),
            angle_unit=str(rng.choice(["m", "mm"] if linear else ["rad", "deg", "turn"])),
            moving=bool(rng.random() < 0.4),
            disturbed=float(rng.choice([0.0, 0.005])),
            noisy=float(rng.choice([0.0, 0.01])),
        )

    @property
    def columns(self) -> ColumnMap:
        """The map to give to `estune explain`, as its options."""
        units = {"current": self.torque_unit, "angle": self.angle_unit}
        sources = {"time": "t", "current": "effort", "angle": "pos"}
        # Of a servo the command is a torque, with a torque constant of 1 N m/A.
        factor = {"mNm": 1e-3, "kN": 1e3}.get(self.torque_unit, 1.0)
        return ColumnMap().with_options(sources, {"angle": units["angle"]}, {"current": factor})

    def write(self, drive: IndependentDrive, folder: Path, rng: np.random.Generator) -> None:
        """Writes the model file, and the logs into `logs`."""
        (folder / "logs").mkdir(parents=True)
        k = KINDS[drive.kind]
        linear = drive.kind == "stage"
        inertia = f"{drive.believed_inertia:.3g}"
        viscous = f"{drive.believed_viscous:.2g}"
        table = (
            f"[stage]\nmass_kg = {inertia}\nviscous_friction_Ns_m = {viscous}\n"
            if linear
            else f"[servo]\ninertia_kg_m2 = {inertia}\nviscous_friction_Nms = {viscous}\n"
        )
        (folder / "model.toml").write_text(f"{table}sampling_Hz = {k.rate_Hz:g}\n", "utf-8")
        for n, seconds in enumerate(SECONDS):
            t = np.arange(round(seconds * k.rate_Hz)) / k.rate_Hz
            reference = _reference(n, t, drive, rng)
            if not self.moving:
                begun = np.clip(t / SOFT_START_s, 0.0, 1.0)
                reference = reference[0] + (reference - reference[0]) * begun**2
            columns = self._measured(drive, reference, rng)
            self._save(folder / "logs" / f"run{n}.csv", k.rate_Hz, columns, rng)

    def _measured(
        self, drive: IndependentDrive, reference: Column, rng: np.random.Generator
    ) -> tuple[Column, Column]:
        k = KINDS[drive.kind]
        still = np.zeros(reference.size)
        speed = float(reference[1] - reference[0]) * k.rate_Hz
        begin = {"start": float(reference[0]), "start_speed": speed if self.moving else 0.0}
        numbers = {**drive.numbers, **begin}
        noise = 0.3 * self.step * rng.standard_normal(reference.size)
        quiet = DriveInputs(reference, still, still)
        usual = float(run(numbers, k.rate_Hz, quiet)[0].std())
        pushed = self.disturbed * usual * coloured(reference.size, 20.0 / k.rate_Hz, rng)
        command, position = run(numbers, k.rate_Hz, DriveInputs(reference, pushed, noise))
        logged = self.noisy * usual * coloured(reference.size, 200.0 / k.rate_Hz, rng)
        return command + logged, position

    def _save(
        self,
        file: Path,
        rate_Hz: float,
        columns: tuple[Column, Column],
        rng: np.random.Generator,
    ) -> None:
        command, position = columns
        t = np.arange(command.size) / rate_Hz
        stamps, digits = t, 6
        if self.clock == "jittered":
            stamps = t + rng.uniform(0.0, 0.3 / rate_Hz, t.size)
        if self.clock == "rounded":
            digits = 3 if rate_Hz < 1000.0 else 2
        to = {"mNm": 1e3, "kN": 1e-3}.get(self.torque_unit, 1.0)
        per = {"deg": 180.0 / math.pi, "turn": 0.5 / math.pi, "mm": 1e3}.get(self.angle_unit, 1.0)
        counts = np.round(position / self.step)
        rows = [
            f"{a:.{digits}f},{u * to:.8g},{n * self.step * per:.10g}"
            for a, u, n in zip(stamps, command, counts, strict=True)
        ]
        file.write_text("\n".join(["t,effort,pos", *rows]) + "\n", "utf-8")


def coloured(samples: int, cutoff: float, rng: np.random.Generator) -> Column:
    """First-order coloured noise of size one; the cutoff relative to the sampling rate."""
    from scipy.signal import lfilter  # noqa: PLC0415  slow to import

    pole = math.exp(-2.0 * math.pi * min(cutoff, 0.5))
    noise = lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal(samples))
    return np.asarray(noise)


def _reference(
    record: int, t: Column, drive: IndependentDrive, rng: np.random.Generator
) -> Column:
    """What a drive is asked to follow: waves of several speeds, or moves with pauses."""
    k = KINDS[drive.kind]
    if record == 0:
        shares = ((0.62, 0.55), (0.3, 1.3), (0.08, 5.1))
        parts = (
            a * np.sin(2.0 * math.pi * f * k.speed_Hz * t + rng.uniform(0.0, 6.0))
            for a, f in shares
        )
        slow = 1.0 - 0.8 * np.exp(-(((t - 0.6 * t[-1]) / 1.5) ** 2))
        return np.asarray(k.travel * slow * sum(parts))
    moves = np.concatenate([[0.0], k.travel * rng.uniform(-1.0, 1.0, 40)])
    each = 0.9 / k.speed_Hz
    number = np.minimum((t / each).astype(int), 39)
    s = np.clip((t / each - number) / 0.8, 0.0, 1.0)
    smooth = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return np.asarray(moves[number] + (moves[number + 1] - moves[number]) * smooth)
