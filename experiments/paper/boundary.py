"""Fig. 18: is hybrid control stable at the workspace boundary, with and without update?"""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from estune.support.plot_style import BLUE, GREY, VERMILION, finish, legend, stacked
from experiments.paper import PaperFigure
from experiments.paper.demonstrations.workspace_boundary import (
    BoundaryTraces,
    BoundaryTrial,
    reference_boundary_trial,
    run_boundary,
)


class Extremes(NamedTuple):
    """Extreme values of one run."""

    jump_N: float
    switches: int
    least_tension_N: float
    greatest_tension_N: float
    beyond_m: float

    @classmethod
    def of(cls, traces: BoundaryTraces, trial: BoundaryTrial) -> "Extremes":
        """The extremes of a run's traces."""
        return cls(
            float(np.abs(traces.jump_N).max()),
            int(np.count_nonzero(np.diff(traces.in_tension))),
            float(traces.tension_N.min()),
            float(traces.tension_N.max()),
            float(traces.position_m.max()) - trial.boundary_m,
        )


def figure_18(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one run suffices
    """Fig. 18."""
    trial = reference_boundary_trial()
    handed, parallel = run_boundary(trial)
    on, off = Extremes.of(handed, trial), Extremes.of(parallel, trial)
    least = trial.rules.tension_min_N
    stable = on.jump_N < 1e-9 and on.least_tension_N > least and on.switches > 0
    unstable = off.least_tension_N == 0.0
    return PaperFigure(
        number=18,
        title="Stability of position/tension hybrid control with and without integration values "
        "update",
        claim="At the boundary of the workspace the hybrid control is stable when the integral "
        "values are updated by (36) and (37), and unstable when they are not.",
        holds=stable and unstable,
        measured=f"With the update the effort jumps by at most {on.jump_N:.0e} N over "
        f"{on.switches} switches, and the tension stays from {on.least_tension_N:.1f} to "
        f"{on.greatest_tension_N:.1f} N; the platform yields by "
        f"{1000.0 * on.beyond_m:.0f} mm. Without, the effort jumps by up to {off.jump_N:.0f} N "
        f"over {off.switches} switches, the tension varies from {off.least_tension_N:.1f} to "
        f"{off.greatest_tension_N:.0f} N, and the platform moves {off.beyond_m:.1f} m beyond the "
        "boundary.",
        rule=f"With the update no jump beyond rounding and never less than {least:g} N; without "
        "it the cable goes slack.",
        caveat="One reel, its platform pushed outward by an oscillating force. The paper's (36) "
        "and (37) are not printed in full; what runs here is their derivation, in which each "
        "controller's integral tracks the effort of the active one.",
        numbers={
            "jump_N": on.jump_N,
            "jump_without_N": off.jump_N,
            "least_tension_N": on.least_tension_N,
            "least_tension_without_N": off.least_tension_N,
            "switches": float(on.switches),
            "switches_without": float(off.switches),
        },
        figure=_draw(handed, parallel, trial),
    )


def _draw(handed: BoundaryTraces, parallel: BoundaryTraces, trial: BoundaryTrial) -> Figure:
    figure, (position, tension) = stacked(2, 4.4)
    looks = ((parallel, VERMILION, 0.8, "without update"), (handed, BLUE, 1.3, "with update"))
    for traces, colour, width, name in looks:
        for ax, column in ((position, 1000.0 * traces.position_m), (tension, traces.tension_N)):
            ax.plot(traces.time_s, column, color=colour, linewidth=width, label=name)
    position.axhline(
        1000.0 * trial.boundary_m, color=GREY, linestyle="--", linewidth=0.9, label="boundary"
    )
    # Without the update the platform leaves; the axis shows the range where it should stay.
    low, high = 1000.0 * handed.position_m.min(), 1000.0 * handed.position_m.max()
    position.set_ylim(1.2 * low - 0.2 * high, 2.0 * high - low)
    # From zero, a slack cable, to hundreds of newtons.
    tension.set_yscale("symlog", linthresh=10.0)
    tension.set_ylim(bottom=0.0)
    tension.set_yticks([0, 5, 10, 20, 50, 100, 200])
    tension.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    finish(position, "platform outward, mm")
    finish(tension, "tension, N", "time, s")
    legend(position)
    return figure
