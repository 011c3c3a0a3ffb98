"""Physical effects that may be added to a reel, one small class each.

`reel + Effect(...)` is a new reel. Its equations are written with CasADi once; the trial is
simulated, differentiated and fitted from the same text. All that the program knows of an effect
is declared in its class; see `plants.effects.effect`. An effect of one's own is a class like
those of this package, here a spring that winds the cable in, as of a reel for a hose:

```python
from dataclasses import dataclass
from plants.effects import Effect, Port, parameter


@dataclass(frozen=True)
class RewindSpring(Effect):
    name = "rewind_spring"
    title = "spring that rewinds the drum"
    appearance = "less current than the tension takes, less still when paid out"
    port = Port.DRUM
    torque_Nm: float = parameter(0.05, low=0.0, high=1.0, unit="N m", neutral=0.0)
    turns: float = parameter(5.0, low=1.0, high=50.0)

    @staticmethod
    def respond(p, state, signal, site):
        return state, p.torque_Nm * (1.0 - site.angle_rad / (6.2832 * p.turns))

    rest = respond  # the same when settled
```

It is found by `find("module:RewindSpring")`, or by its slug once its package declares the entry
point `rewind_spring = "module:RewindSpring"` in the group `estune.effects`.
"""

import importlib
from importlib.metadata import entry_points

from estune.errors import InvalidInput
from plants.effects.backlash import Backlash as Backlash
from plants.effects.bent_viscous_friction import BentViscousFriction as BentViscousFriction
from plants.effects.cable_creep import CableCreep as CableCreep
from plants.effects.cable_slack import CableSlack as CableSlack
from plants.effects.cable_stiffening import CableStiffening as CableStiffening
from plants.effects.cable_weight import CableWeight as CableWeight
from plants.effects.cogging import Cogging as Cogging
from plants.effects.coulomb_friction import CoulombFriction as CoulombFriction
from plants.effects.current_lag import CurrentLag as CurrentLag
from plants.effects.current_saturation import CurrentSaturation as CurrentSaturation
from plants.effects.dahl_hysteresis import DahlHysteresis as DahlHysteresis
from plants.effects.dead_time import DeadTime as DeadTime
from plants.effects.directional_friction import DirectionalFriction as DirectionalFriction
from plants.effects.drum_eccentricity import DrumEccentricity as DrumEccentricity
from plants.effects.effect import Effect as Effect
from plants.effects.effect import Port as Port
from plants.effects.effect import Signal as Signal
from plants.effects.effect import Site as Site
from plants.effects.eyelet_friction import EyeletFriction as EyeletFriction
from plants.effects.gain_error import GainError as GainError
from plants.effects.gauge_drift import GaugeDrift as GaugeDrift
from plants.effects.gauge_nonlinearity import GaugeNonlinearity as GaugeNonlinearity
from plants.effects.gauge_offset import GaugeOffset as GaugeOffset
from plants.effects.gauge_resonance import GaugeResonance as GaugeResonance
from plants.effects.link_gravity import LinkGravity as LinkGravity
from plants.effects.load_friction import LoadFriction as LoadFriction
from plants.effects.mains_interference import MainsInterference as MainsInterference
from plants.effects.parameter import Parameter as Parameter
from plants.effects.parameter import RecordScale as RecordScale
from plants.effects.parameter import Role as Role
from plants.effects.parameter import Share as Share
from plants.effects.parameter import parameter as parameter
from plants.effects.parameter import phase as phase
from plants.effects.quantisation import Quantisation as Quantisation
from plants.effects.rate_limit import RateLimit as RateLimit
from plants.effects.sticking_actuator import StickingActuator as StickingActuator
from plants.effects.stribeck_friction import StribeckFriction as StribeckFriction
from plants.effects.string_mode import StringMode as StringMode
from plants.effects.structural_mode import StructuralMode as StructuralMode
from plants.effects.torque_ripple import TorqueRipple as TorqueRipple
from plants.effects.viscous_damping import ViscousDamping as ViscousDamping

EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in list(vars().values())
    if isinstance(effect, type) and issubclass(effect, Effect) and effect is not Effect
}
"""The effects of this package by slug."""

GROUP = "estune.effects"
"""Entry point group in which packages declare effects of their own."""


def find(name: str) -> type[Effect]:
    """The effect of a slug, one declared by another package, or one named as module:attribute.

    Args:
        name: A slug such as `coulomb_friction`, or "module:attribute".

    Raises:
        InvalidInput: there is none, or what is there is no effect.
    """
    if name in EFFECTS:
        return EFFECTS[name]
    module, colon, attribute = name.partition(":")
    declared = {point.name: point for point in entry_points(group=GROUP)}
    try:
        if colon:
            loaded = getattr(importlib.import_module(module), attribute)
        elif name in declared:
            loaded = declared[name].load()
        else:
            names = ", ".join(sorted({*EFFECTS, *declared}))
            raise InvalidInput(
                f"there is no effect {name!r}; there are {names}, and your own as module:attribute"
            )
    except (ImportError, AttributeError, ValueError) as error:
        raise InvalidInput(f"effect {name!r} cannot be loaded: {error}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, Effect)):
        raise InvalidInput(f"{name!r} is {loaded!r}; an effect is a class derived from Effect")
    return loaded


def declared() -> tuple[type[Effect], ...]:
    """All effects there are: those of this package, then those other packages declare.

    Raises:
        InvalidInput: one that another package declares cannot be loaded.
    """
    others = sorted({point.name for point in entry_points(group=GROUP)} - set(EFFECTS))
    return (*EFFECTS.values(), *map(find, others))
