"""Physical effects that may be added to a reel, one small class each."""

from plants.effects.coulomb_friction import CoulombFriction
from plants.effects.effect import Effect, Parameter, Port, Site, parameter

__all__ = ["CoulombFriction", "Effect", "Parameter", "Port", "Site", "parameter"]
