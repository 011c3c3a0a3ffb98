"""Equations of one sample of a plant, as CasADi functions.

The same functions are simulated (`plants.simulation.trial_loop`), differentiated and exported.
`prepare` computes everything that depends on the parameters alone, such as the matrix exponential,
once per trial; the other functions take the results as one vector of constants.
"""

from types import SimpleNamespace
from typing import Any, NamedTuple

import casadi as ca

# Numpy's functions then accept CasADi expressions, and `estune.core.pidf.step` serves for the
# simulated controller too.
ca.GlobalOptions.setNumpyMode(1)

Expression = Any
"""A CasADi SX expression; the library carries no types."""


class Equations(NamedTuple):
    """Equations of one plant structure; all functions take and return dense SX columns.

    The drive is the delayed signal, such as the motor current of a reel. Within a sample the drive
    changes once, after the dead time's fraction of a sample. The diagnosis needs
    `dead_time_samples`, `settle`, `locate` and `place`.
    """

    prepare: Expression  # (parameters, preload) -> (constants, state at rest, effort at rest)
    observe: Expression  # (constants, state, present drive, noise) -> (state, measurement, angle)
    drive: Expression  # (constants, state, effort) -> (state, drive)
    # (constants, state, drive before, drive after, n) -> state after the nth substep.
    substep: Expression
    substeps: int  # number of substeps in a sample
    # (constants, state) -> reading of a gauge outside the reel; None without one.
    outside: Expression | None = None
    # (parameters) -> dead time in samples, with that of the effects.
    dead_time_samples: Expression = None
    # (constants, measurement) -> (state, effort) at rest at that measurement.
    settle: Expression = None
    # (constants, state) -> observable part of the state in measured units: angle and velocity of a
    # drum, output and its derivatives of a linear plant.
    locate: Expression = None
    # (constants, state, observable part) -> state with that observable part.
    place: Expression = None

    def move(
        self, constants: Expression, state: Expression, before: Expression, after: Expression
    ) -> Expression:
        """State one sample later."""
        for n in range(self.substeps):
            state = self.substep(constants, state, before, after, n)
        return state


def dense_function(name: str, inputs: list[Expression], *outputs: Expression) -> Expression:
    """A function with dense outputs."""
    # Of a sparse output the generated C writes the nonzeros alone, one after the other.
    return ca.Function(name, inputs, [ca.densify(output) for output in outputs])


def pack_constants(
    constants: SimpleNamespace,
) -> tuple[Expression, Expression, SimpleNamespace]:
    """SX expressions by name as one dense column, and matching symbols.

    Only structural nonzeros are included, so that products with sparse matrices stay sparse.

    Returns:
        The column of values, the column of symbols, and the symbols by name.
    """
    symbols = {name: ca.SX.sym(name, value.sparsity()) for name, value in vars(constants).items()}
    values, column = (
        ca.densify(ca.vertcat(*(ca.vec(value.nz[:]) for value in part.values())))
        for part in (vars(constants), symbols)
    )
    return values, column, SimpleNamespace(**symbols)


def held_input(
    A: Expression, B: Expression, span: Expression, squarings: int
) -> tuple[Expression, Expression]:
    """Exact propagation of `x' = A x + B u` over a span during which u is held.

    x(t + span) = Phi x(t) + Gamma u, with Phi = exp(A span) and Gamma = int_0^span exp(A s) ds B.
    Psi, the integral, is summed as its Taylor series over span / 2^squarings and doubled back by
    Psi(2h) = Psi(h) + Phi(h) Psi(h), where Phi = I + A Psi (Moler & Van Loan 2003, method 3, for
    the integral of the exponential).

    Args:
        A: State matrix, shape (n, n), 1/s.
        B: Input matrix, shape (n, m).
        span: Length of the span, s; a number or a scalar expression.
        squarings: Number of doublings; exact to rounding while the fastest rate of A times the
            span is at most 2^squarings (the series is cut after degree 20; 1/21! is 2e-20).

    Returns:
        Phi, shape (n, n), and Gamma, shape (n, m).
    """
    identity = ca.SX.eye(A.shape[0])
    part = span / 2**squarings
    psi = identity
    for degree in range(20, 0, -1):
        psi = identity + (part / (degree + 1)) * (A @ psi)
    psi = part * psi
    for _ in range(squarings):
        psi = psi + psi + (A @ psi) @ psi
    return identity + A @ psi, psi @ B
