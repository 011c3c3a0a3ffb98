"""What a compiled plant is made of: CasADi expressions of one sample, and how to carry constants.

A plant is written once, as four CasADi functions; they are simulated (`plants.simulation.trial_loop`),
differentiated and exported from the same text. Everything that depends on the plant's parameters
alone, above all the matrix exponential, is worked out once per trial by `prepare` and handed to
the others as one vector of constants.
"""

from typing import Any, NamedTuple, TypeVar

import casadi as ca

# Lets numpy's functions act on CasADi expressions, so that `estune.core.pidf.step` is the text of
# the simulated controller too. Without it CasADi warns that this will become the default.
ca.GlobalOptions.setNumpyMode(1)

Expression = Any
"""A CasADi SX expression; the library carries no types."""


class Equations(NamedTuple):
    """One plant structure; all functions take and return dense SX columns.

    `drive` is what travels through the dead time, the motor current of a reel. Within a sample the
    drive changes once, when the dead time's fraction of a sample has passed.

    Attributes:
        prepare: (parameters, preload) -> (constants, state at rest, effort at rest).
        observe: (constants, state, drive in force, noise) -> (state, measurement, angle).
        drive: (constants, state, effort) -> (state, drive).
        substep: (constants, state, drive before, drive after, n) -> state after the nth substep.
        substeps: Number of substeps in a sample.
        outside: (constants, state) -> what a gauge outside the reel reads; None where there is
            no such gauge.
        late: (parameters) -> the dead time with what effects add to it, in samples.
        settle: (constants, measurement) -> (state, effort) of the plant at rest where it reads so.
        locate: (constants, state) -> what of the state a record can show, in measured units: the
            angle and the velocity of a drum, the output and its derivatives of a linear plant.
        place: (constants, state, the same) -> the state put there. This and the three before are
            for plants that are held against records.
    """

    prepare: Expression
    observe: Expression
    drive: Expression
    substep: Expression
    substeps: int
    outside: Expression | None = None
    late: Expression = None
    settle: Expression = None
    locate: Expression = None
    place: Expression = None

    def move(
        self, constants: Expression, state: Expression, before: Expression, after: Expression
    ) -> Expression:
        """The state one sample later."""
        for n in range(self.substeps):
            state = self.substep(constants, state, before, after, n)
        return state


Constants = TypeVar("Constants", bound=tuple[Any, ...])


def pack(constants: Constants) -> tuple[Expression, Constants]:
    """The constants as one dense column, and symbols of the same form to write equations with.

    Only structural nonzeros are carried, so that a product with a sparse matrix stays sparse.

    Args:
        constants: A named tuple of SX expressions, any shapes.

    Returns:
        The column of values, and a named tuple of symbols; `column_of` the latter is the matching
        column of symbols.
    """
    symbols = type(constants)(
        *(
            ca.SX.sym(name, value.sparsity())
            for name, value in zip(constants._fields, constants, strict=True)  # type: ignore[attr-defined]
        )
    )
    return column_of(constants), symbols


def column_of(constants: tuple[Any, ...]) -> Expression:
    """The structural nonzeros of all the constants, as one dense column."""
    return ca.densify(ca.vertcat(*(ca.vec(value.nz[:]) for value in constants)))


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
