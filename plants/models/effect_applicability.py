"""Whether an effect can be added to a linear plant, and why not."""

from functools import lru_cache
from types import SimpleNamespace

import casadi as ca
import numpy as np

from plants.effects.effect import Effect, Port
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.pole_zero_form import LinearBase


@lru_cache(maxsize=512)
def unavailable(base: LinearBase, effect: type[Effect]) -> str | None:
    """Reason why an effect cannot be added to a linear plant; None where it can."""
    names = dict.fromkeys((*base.own, *_COMMON_NAMES))
    symbols = ca.vertsplit(ca.SX.sym("p", len(names)))
    motion = base.motion(SimpleNamespace(**dict(zip(names, symbols, strict=True))))
    # An effect of the drum acts without a cable, too.
    ports = {effect.port} if base.is_drum and effect.port is Port.DRUM else set(effect.ports())
    missing = (
        {Port.CABLE, Port.EYELET, Port.GAUGE} if base.is_drum else {Port.EYELET, Port.ENCODER}
    )
    if ports == {Port.DRUM, Port.GAUGE}:  # offset and gain apply to any plant
        missing = set()
    elif not base.is_drum and motion.V is None:
        missing |= {Port.DRUM, Port.CABLE}
    elif not base.is_drum and (motion.restoring is None or motion.restoring.is_zero()):
        missing |= {Port.CABLE}
    still = motion.restoring is None or motion.restoring.is_zero()
    loaded = base.is_drum and effect.resists  # by the torque that a gear passes on
    if effect.by_tension and still and not loaded and not ports & missing:
        return f"it depends on the level of a tension, {_ABSENT[base.is_drum]}"
    if ports & missing:
        return f"it acts at the {min(ports & missing)}, {_ABSENT[base.is_drum]}"
    try:
        if Port.CABLE in ports and not _may_push(base, effect):
            return "it lets a cable go slack, and the plant's spring also pushes"
        LinearEffectStructure(base, (effect,), fractional=True, squarings=0).equations()
    except AttributeError as error:
        missing_name = str(error).rpartition("attribute ")[2].strip("'")
        return f"it needs {missing_name}, which such a plant does not have"
    except (TypeError, NotImplementedError):  # raised by CasADi for an angle of None
        return "it depends on the angle of a drum, and the plant's output is no angle"
    return None


def _may_push(base: LinearBase, effect: type[Effect]) -> bool:
    """Whether the effect at its neutral value leaves a pushing spring unchanged."""
    moved = []
    for added in ((), (effect.neutral(),)):
        structure = LinearEffectStructure(base, tuple(type(e) for e in added), True, 0)  # noqa: FBT003
        equations, n = structure.equations(), base.order
        rates = {"sampling_Hz": 1e3, "dead_time_s": 0.0, "delay_samples": 0.0}
        own = [rates.get(name, 1.0) for name in (*structure.own_names, "delay_samples")]
        values = [*own, *(getattr(e, name) for e in added for name in e.parameters())]
        constants, _, _ = equations.prepare(values, 1.0)
        state, _ = equations.settle(constants, -1.0)
        state[:n] = -np.eye(n)[0]  # on the far side of rest, where the spring pushes
        moved.append(np.asarray(equations.substep(constants, state, 0.0, 0.0, 0))[:n])
    return bool(np.allclose(moved[0], moved[1], rtol=1e-6, atol=1e-9))


MOVED_BY_TORQUE = (
    "it is of an actuator that has a position, and a motor's torque moves the machine"
)

_COMMON_NAMES = ("torque_unit", "angle_unit", "viscous_friction_Nms")
_ABSENT = {
    True: "which a drive without a cable does not have",
    False: "which takes an output that moves like a position and a spring that holds it; "
    "describe the motor of a speed as a [servo]",
}
