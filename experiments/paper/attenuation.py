"""Fig. 7: does the attenuation ratio of a reel depend on the tension setpoint?"""

from matplotlib.figure import Figure

from estune.support.plot_style import BLUE, GREY, VERMILION, finish, legend, stacked
from experiments.paper import PaperFigure
from experiments.paper.two_reels import (
    WEBER_LIMIT,
    Eyelet,
    ReelModel,
    SimulatedBench,
    TwoReelProcedure,
    TwoReelResult,
    evaluate,
)

SETPOINTS_N = (5.0, 8.0, 12.0, 18.0, 26.0, 36.0)
COULOMB = Eyelet()
GROWING = Eyelet(growth_per_N=1e-3)


def measure(eyelet: Eyelet, sweeps: int, seed: int) -> TwoReelResult:
    """The two-reel procedure of section IV-D on two reels with this eyelet."""
    reel = ReelModel(eyelet=eyelet)
    procedure = TwoReelProcedure(SETPOINTS_N, sweeps=sweeps)
    return evaluate(procedure.run(SimulatedBench(reel, reel, seed=seed)), eyelet.angles_rad)


def falls(result: TwoReelResult) -> bool:
    """Whether the attenuation ratio falls significantly with the tension."""
    return not result.curve.follows_coulomb and result.curve.quadratic.value > 0.0


def figure_7(*, quick: bool = False) -> PaperFigure:
    """Fig. 7."""
    sweeps = 4 if quick else 8
    coulomb, growing = measure(COULOMB, sweeps, seed=1), measure(GROWING, sweeps, seed=2)
    low, high = SETPOINTS_N[0], SETPOINTS_N[-1]
    ratios, grown = (
        [estimate.value for estimate in result.ratio_at_setpoints()]
        for result in (coulomb, growing)
    )
    slope = -coulomb.curve.quadratic.value
    share = coulomb.transparency()
    return PaperFigure(
        number=7,
        title="Attenuation ratio in function of the tension setpoints",
        claim="The performance of the reel decreases with an increase of the tension setpoint.",
        holds=falls(coulomb),
        measured=f"B is {ratios[0]:.4f} at {low:g} N and {ratios[-1]:.4f} at {high:g} N; its "
        f"slope of {1e6 * slope:.0f} millionths per N has a p value of "
        f"{coulomb.curve.quadratic_p_value:.2f}. Friction takes "
        f"{100.0 * share.friction_share:.1f} % of the tension, where (29) allows "
        f"{100.0 * WEBER_LIMIT:g} %, and B spreads over the setpoints (27) by "
        f"{1e6 * share.log_spread:.0f} millionths. On a second bench, whose friction coefficient "
        f"grows by {1e3 * GROWING.growth_per_N:g} thousandth per N, B falls from {grown[0]:.4f} "
        f"to {grown[-1]:.4f}.",
        rule="B falls significantly with the tension (1 %), on two reels whose eyelets obey "
        "Coulomb's law.",
        caveat="Coulomb's law, which the paper's own (20) to (25) assume, makes B depend on the "
        "friction coefficient and the angle alone, whatever the tension. A fall of B, as in "
        "the paper, means that its eyelet did not obey that law. Where friction does grow, on the "
        "second bench, the two-reel procedure "
        + ("detects it." if falls(growing) else "does not detect it, with so few sweeps."),
        numbers={
            "B_low": ratios[0],
            "B_high": ratios[-1],
            "chance": coulomb.curve.quadratic_p_value,
            "friction_share": share.friction_share,
            "B_growing_low": grown[0],
            "B_growing_high": grown[-1],
        },
        figure=_draw(coulomb, growing),
    )


def _draw(coulomb: TwoReelResult, growing: TwoReelResult) -> Figure:
    figure, (ax,) = stacked(1, 3.0)
    for result, colour, marker, name in (
        (coulomb, BLUE, "o", "Coulomb's law"),
        (growing, VERMILION, "s", "friction that grows with the tension"),
    ):
        estimates = result.ratio_at_setpoints()
        middle = [estimate.value for estimate in estimates]
        half = [estimate.high - estimate.value for estimate in estimates]
        ax.errorbar(
            result.setpoint_N, middle, half, fmt=f"{marker}-", color=colour, linewidth=1.0,
            markersize=4.0, capsize=3.0, label=name,
        )  # fmt: skip
    ax.axhline(1.0 - WEBER_LIMIT, color=GREY, linestyle="--", linewidth=0.9, label="limit of (29)")
    finish(ax, "attenuation ratio B", "tension setpoint, N")
    legend(ax)
    return figure
