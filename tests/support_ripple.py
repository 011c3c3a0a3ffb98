"""A rig in virtual time whose drum has a ripple, and whose file has a map of it."""

import math
from dataclasses import asdict, replace

from estune.core.gains import Gains
from estune.proof.patch import Patch
from estune.proof.trials import prove
from experiments.virtual_loop import virtual_rig
from tests.support_hardware import config

GAINS = Gains(0.78, 31.0, 0.0206, 0.0003)
WAVES, TORQUE_Nm = 40.0, 0.1
"""As steep as the reel can hold everywhere: a map of it shows beside the lag of a triangle."""
MAP = {
    "zero": "absolute",
    "orders": [WAVES],
    "torque_Nm": [TORQUE_Nm],
    "phase_rad": [0.0],
    "lead_s": 0.0024,
}
PATCH = Patch("torque_ripple", "feed a map forward", "", {"angle_map": MAP})


def rippled(name: str = "drum", *, moved: bool = False, on: bool = True):
    """The rig; of a map whose zero is moved, the drum's ripple lies half a wave further on."""
    ripple = {"name": "torque_ripple", "amplitude_Nm": TORQUE_Nm, "per_turn": WAVES}
    ripple["phase_rad"] = math.pi if moved else 0.0
    settings = {"effects": [ripple], "electronics": {"watchdog_s": 0.02}, "seed": 1}
    changes = {"name": name, "driver__settings": settings, "motion__take_up_A": 0.5}
    changes["gains"] = asdict(GAINS)
    if on:
        changes["compensation"] = {"angle_map": MAP}
    return virtual_rig(config(**changes))


def proven_patch(path):
    """The patch with its proof, by trials on that rig without it."""
    with rippled(on=False) as rig:
        patch = replace(PATCH, proof=prove(rig, PATCH).to_json())
    patch.write(path)
    return patch
