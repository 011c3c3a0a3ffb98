"""Equations of one sample of a plant whose effects sit along a signal path.

The linear part is propagated exactly over each of four substeps a sample. Within a sample the
drive changes once, after the dead time's fraction of a sample.
"""

import math
from abc import abstractmethod
from types import SimpleNamespace
from typing import Any, Protocol

import casadi as ca

from plants.models.effect_stages import EffectStages
from plants.models.parameters import Parameters, ParametricStructure
from plants.simulation.equations import (
    Equations,
    Expression,
    dense_function,
    held_input,
    pack_constants,
)

GRAVITY_M_S2 = 9.80665
"""Standard gravity, ISO 80000-3."""

SUBSTEPS = 4

EffectNumbers = list[dict[str, Expression]]
"""Parameters and prepared constants of each effect, by name."""


class SignalPath(Protocol):
    """The stages of a plant between effort and measurement, in one set of constants."""

    @property
    def stages(self) -> EffectStages:
        """The effects."""

    def drive(self, x: Expression, effort: Expression) -> list[Expression]:
        """State and drive for an effort."""

    def substep(self, x: Expression, driven: Expression) -> Expression:
        """State one substep later; `driven` is the drive's contribution to it."""

    def observe(self, x: Expression, before: Expression, noise: Expression) -> list[Expression]:
        """State, measurement and angle."""

    def rest(self, reading: Expression) -> tuple[Expression, Expression]:
        """State and effort at rest at a measurement."""

    def locate(self, x: Expression) -> Expression:
        """The part of the state that a record shows."""

    def place(self, x: Expression, target: Expression) -> Expression:
        """State whose observable part is the target."""

    def outside(self, x: Expression) -> Expression | None:
        """Reading of a gauge outside; None where there is none."""


class PathStructure(ParametricStructure):
    """Structure of a plant with a signal path; one compilation serves all plants of it."""

    fractional: bool  # whether the dead time is not a whole number of samples
    squarings: int  # doublings in the matrix exponential; see `simulation.equations.held_input`

    @property
    @abstractmethod
    def placed_states(self) -> int:
        """Number of observable states."""

    @abstractmethod
    def _constants(
        self, parameters: Expression, preload: Expression
    ) -> tuple[SimpleNamespace, EffectNumbers]:
        """Constants of a trial, and each effect's part of them, by name."""

    @abstractmethod
    def _path(self, c: SimpleNamespace, numbers: EffectNumbers) -> SignalPath:
        """The signal path with these constants."""

    def equations(self) -> Equations:
        """The plant's equations of one sample.

        Raises:
            AttributeError: an effect asks for a parameter that the plant does not have.
        """
        parameters = ca.SX.sym("parameters", len(self.parameter_names))
        preload, noise, effort = (ca.SX.sym(name) for name in ("preload", "noise", "effort"))
        before, after, n = (ca.SX.sym(name) for name in ("before", "after", "n"))
        values, numbers = self._constants(parameters, preload)
        column, constants, c = pack_constants(values)
        rest, rest_effort = self._path(values, numbers).rest(preload)
        symbols = iter(ca.vertsplit(c.effects))
        path = self._path(c, [{name: next(symbols) for name in one} for one in numbers])
        x, reading = ca.SX.sym("x", path.stages.states), ca.SX.sym("reading")
        placed = ca.SX.sym("placed", self.placed_states)
        settled, settled_effort = path.rest(reading)
        moved = path.substep(x, self._driven(c, n, before, after))
        outside = path.outside(x)

        return Equations(
            prepare=dense_function("prepare", [parameters, preload], column, rest, rest_effort),
            observe=dense_function(
                "observe", [constants, x, before, noise], *path.observe(x, before, noise)
            ),
            drive=dense_function("drive", [constants, x, effort], *path.drive(x, effort)),
            substep=dense_function("substep", [constants, x, before, after, n], moved),
            substeps=SUBSTEPS,
            dead_time_samples=dense_function(
                "dead_time_samples", [parameters], self.dead_time_samples(parameters)
            ),
            settle=dense_function("settle", [constants, reading], settled, settled_effort),
            locate=dense_function("locate", [constants, x], path.locate(x)),
            place=dense_function("place", [constants, x, placed], path.place(x, placed)),
            outside=None
            if outside is None
            else dense_function("outside", [constants, x], outside),
        )

    def _driven(self, c: Any, n: Expression, before: Expression, after: Expression) -> Expression:
        """The drive's contribution to the state over the nth substep."""
        if not self.fractional:
            return c.by_drive * after
        jump = after - before
        return c.by_drive * (before + (n > c.change) * jump) + c.by_drive_after * (
            (n == c.change) * jump
        )

    def _drive_change(
        self, A: Expression, by_drive: Expression, p: SimpleNamespace, delay: Expression
    ) -> tuple[Expression, Expression]:
        """Number of the substep in which the drive changes, and Gamma for the rest of it."""
        if not self.fractional:
            return ca.SX(0, 0), ca.SX(A.shape[0], 0)
        h = 1.0 / (p.sampling_Hz * SUBSTEPS)
        fraction = p.dead_time_s * p.sampling_Hz - delay
        change = ca.floor(SUBSTEPS * fraction)
        _, after = held_input(A, by_drive, h * (change + 1 - SUBSTEPS * fraction), self.squarings)
        return change, after


def squarings_for(fastest_rad_s: float, sampling_Hz: float) -> int:
    """Doublings that keep the matrix exponential exact for a plant with this fastest rate."""
    return max(0, math.ceil(math.log2(fastest_rad_s / (sampling_Hz * SUBSTEPS))))


def prepare_effects(
    parameters: Parameters, p: SimpleNamespace, preload: Expression, **facts: Expression
) -> EffectNumbers:
    """Parameters and prepared constants of each effect.

    Args:
        p: The plant's own, as amended by the effects.
        preload: Preload of the trial, N.
        **facts: Further facts about the plant that effects ask for.
    """
    known = SimpleNamespace(
        **vars(p),
        preload_N=preload,
        gravity_m_s2=GRAVITY_M_S2,
        sample_s=1.0 / p.sampling_Hz,
        **facts,
    )
    return [vars(q) | effect.prepare(q, known) for effect, q in parameters.effects]


def column_of_effects(numbers: EffectNumbers) -> Expression:
    """All constants of the effects as one dense column."""
    return ca.densify(ca.vertcat(*(v for one in numbers for v in one.values())))
