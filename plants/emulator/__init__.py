"""Emulated hardware: a reel in raw counts, in another process and in wall-clock time.

`EmulatedDriver` is a driver for `estune.hardware`; `python -m plants.emulator` is the hardware by
itself, which continues when the program that drives it is killed. `RIG_FILE` is its rig file.
"""

from pathlib import Path

from estune.errors import InvalidInput
from plants.emulator.driver import EmulatedDriver

RIG_FILE = Path(__file__).with_name("rig.toml")

__all__ = ["RIG_FILE", "EmulatedDriver", "example_rig_file"]


HIDDEN = {
    "coulomb": '{ name = "coulomb_friction", torque_Nm = 0.05 }',
    "cogging": '{ name = "cogging", amplitude_1_Nm = 0.03, per_turn_1 = 48.0, phase_1_rad = 0.4 }',
    "ripple": '{ name = "torque_ripple", amplitude_Nm = 0.03, per_turn = 40.0, phase_rad = 0.7 }',
    "gravity": '{ name = "cable_weight", density_kg_m = 0.15 }',
}
"""Effects that the emulated machine has and the reel's model lacks, as `effects` of its driver:
dry friction, a motor that cogs, one tooth of a gear after the other, a hose along the cable.

The sizes are large enough to be named from one set of six experiments in virtual time: each was,
the cogging as a torque ripple, which is the same law on a reel."""
_SEED = "seed = 1 }"


def example_rig_file(hidden: str | None = None) -> str:
    """Text of `RIG_FILE`, printed by `estune serve-hardware --example`.

    Args:
        hidden: Name in `HIDDEN` of what the machine has besides; None for nothing.

    Raises:
        InvalidInput: there is no such effect.
    """
    text = RIG_FILE.read_text()
    if hidden is None:
        return text
    if hidden not in HIDDEN:
        raise InvalidInput(f"--hidden is {hidden}; give one of {', '.join(HIDDEN)}")
    return text.replace(_SEED, f"seed = 1, effects = [{HIDDEN[hidden]}] }}")
