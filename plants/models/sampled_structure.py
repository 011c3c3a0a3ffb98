"""Structure of a linear plant that is sampled exactly under zero-order hold."""

from dataclasses import dataclass
from types import SimpleNamespace

import casadi as ca
import numpy as np

from plants.simulation.equations import Equations, pack_constants


@dataclass(frozen=True, slots=True)
class SampledStructure:
    """Structure of a sampled plant; one compilation serves all linear plants of an order."""

    order: int  # number of states, at least one
    fractional: bool  # whether the dead time is not a whole number of samples

    def equations(self) -> Equations:
        """The difference equation of `estune.core.margins.SampledPlant`."""
        n = self.order
        shapes = [(n, n), (n, 1), (n, 1), (1, n), (1, 1), (n, 1), (1, 1)]
        ends = np.cumsum([rows * columns for rows, columns in shapes]).tolist()
        parameters, preload = ca.SX.sym("parameters", ends[-1]), ca.SX.sym("preload")
        Phi, before_u, now, C, E, rest, rest_effort = (
            ca.reshape(part, *shape)
            for part, shape in zip(ca.vertsplit(parameters, [0, *ends]), shapes, strict=True)
        )
        values, constants, c = pack_constants(
            SimpleNamespace(Phi=Phi, before=before_u, now=now, C=C, E=E)
        )
        x, noise, effort = ca.SX.sym("x", n), ca.SX.sym("noise"), ca.SX.sym("effort")
        before, after = ca.SX.sym("before"), ca.SX.sym("after")
        moved = c.Phi @ x + c.now * after
        if self.fractional:
            moved += c.before * before
        return Equations(
            prepare=ca.Function(
                "prepare", [parameters, preload], [values, rest * preload, rest_effort * preload]
            ),
            observe=ca.Function(
                "observe", [constants, x, before, noise], [x, c.C @ x + c.E * before + noise, 0.0]
            ),
            drive=ca.Function("drive", [constants, x, effort], [x, effort]),
            substep=ca.Function("substep", [constants, x, before, after, ca.SX.sym("n")], [moved]),
            substeps=1,
        )
