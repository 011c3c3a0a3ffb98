"""One effect's law by itself, in numbers."""

from dataclasses import fields
from types import SimpleNamespace

import casadi as ca

from plants.conformance.reel_runs import RATE, REEL, wander
from plants.effects import Port, Site
from plants.models.reel_equations import cable_stiffness_N_m

SUBSTEP_s = 0.25 / RATE
R, J, Kt = REEL.drum_radius_m, REEL.drum_inertia_kg_m2, REEL.torque_constant_Nm_A
k = cable_stiffness_N_m(REEL, 15.0)
b = REEL.viscous_friction_Nms + REEL.viscous_friction_per_length_Ns * REEL.cable_length_m
TAUT = wander(200, 12.0, 20.0)


class Law:
    """One effect's law by itself, in numbers: what goes in is imposed."""

    def __init__(self, effect, reel=REEL, preload=15.0):
        attributes = {f.name: getattr(reel, f.name) for f in fields(reel)}
        self.reel = SimpleNamespace(
            **attributes,
            preload_N=preload,
            stiffness_N_m=cable_stiffness_N_m(reel, preload),
            gravity_m_s2=9.80665,
            sample_s=1.0 / RATE,
            substep_s=SUBSTEP_s,
            torque_per_velocity=1e6,  # a drum that nothing slows
        )
        self.effect = effect
        self.p = SimpleNamespace(**vars(effect), **effect.prepare(self._own(), self.reel))
        self.state = ca.DM.zeros(effect.states)

    def _own(self):
        return SimpleNamespace(**vars(self.effect))

    def site(self, velocity=0.0, angle=0.0, tension=0.0, port=None):
        port = port or self.effect.port
        often = port in (Port.DRUM, Port.CABLE, Port.EYELET)
        span = SUBSTEP_s if often else 1.0 / RATE
        mass = self.reel.torque_per_velocity
        return Site(port, span, angle, velocity, velocity, tension, mass)

    def settle(self, signal, **site):
        """The signal that has to go in for this one to come out steadily."""
        self.state, inside = self.effect.rest(self.p, self.state, signal, self.site(**site))
        return float(inside)

    def pass_(self, signal, **site):
        """The signal after one visit."""
        self.state, out = self.effect.respond(self.p, self.state, signal, self.site(**site))
        return float(out)
