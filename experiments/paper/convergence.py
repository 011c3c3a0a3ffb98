"""Fig. 12: does the convergence of the tuning depend on the cable length?"""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import f_oneway

import estune
from estune.core.quantities import FloatArray
from estune.support.plot_style import finish, legend, stacked
from experiments.paper import PaperFigure
from experiments.paper.curves import FOUR
from experiments.paper.identify.conditions import LENGTHS_m
from plants.models.reel import Reel

TENSION_N = 15.0
TRIALS = 120
TUNER = "otis"
LAST = 20
CHANCE = 0.01


def costs(length_m: float, seed: int) -> FloatArray:
    """Cost of each search trial of one run of the paper's tuner, shape (trials,)."""
    rig = Reel(length_m, TENSION_N).rig(name=f"reel-{length_m:g}-m", seed=seed)
    result = estune.tune(rig, tuner=TUNER, trials=TRIALS, journal=False, watch=None)
    frame = result.to_frame()
    return frame.loc[frame["phase"] == "search", "cost"].to_numpy(dtype=float)


def time_constant(cost: FloatArray) -> float:
    """Time constant in trials: area above the final cost, divided by the initial excess."""
    excess = cost - cost[-LAST:].mean()
    return float(excess.sum() / excess[0])


def figure_12(*, quick: bool = False) -> PaperFigure:
    """Fig. 12."""
    count = 2 if quick else 20
    runs = {
        length: np.array([costs(length, seed) for seed in range(count * n, count * (n + 1))])
        for n, length in enumerate(LENGTHS_m)
    }
    spans = {length: [time_constant(one) for one in some] for length, some in runs.items()}
    chance = float(f_oneway(*spans.values()).pvalue)
    means = {length: float(np.mean(span)) for length, span in spans.items()}
    excess = max(means.values()) / min(means.values()) - 1.0
    first, last = LENGTHS_m[0], LENGTHS_m[-1]
    begin, end = (
        [float(runs[length][:, at].mean()) for length in (first, last)] for at in (0, -1)
    )
    listed = ", ".join(f"{mean:.2f} at {length:g} m" for length, mean in means.items())
    return PaperFigure(
        number=12,
        title="Evolution of the cost function for different cable lengths",
        claim="The convergence of the extremum-seeking tuning is influenced by the cable's "
        "length.",
        holds=chance < CHANCE,
        measured=f"The cost falls with a time constant of {listed} trials (means of "
        f"{count} runs), the longest {100.0 * excess:.1f} % above the "
        "shortest; the p value of "
        f"the difference is {chance:.1e}. The cost begins at {begin[0]:.2f} and ends at "
        f"{end[0]:.2f} at {first:g} m, {begin[1]:.2f} and {end[1]:.2f} at {last:g} m.",
        rule="The time constant differs between the lengths significantly, "
        f"at {100.0 * CHANCE:g} % (one-way analysis of variance).",
        caveat=f"The paper's tuner ({TUNER}) from the same gains at every length; lines are "
        "means, bands the least and greatest cost of a trial over the runs, which differ in the "
        "gauge's noise alone. The time constant is the area of the cost above its final value, "
        f"the mean of the last {LAST} trials, divided by the initial excess. The cost is (35) "
        "with the default control-move penalty.",
        numbers={"chance": chance, "excess": excess, "runs": float(count)}
        | {f"time_constant_at_{length:g}_m": mean for length, mean in means.items()},
        figure=_draw(runs),
    )


def _draw(runs: Mapping[float, FloatArray]) -> Figure:
    """Mean and range of the cost over the runs at each length."""
    figure, (ax,) = stacked(1, 3.0)
    for (length, some), look in zip(runs.items(), FOUR, strict=True):
        trial = np.arange(1, TRIALS + 1)
        band = some.min(axis=0), some.max(axis=0)
        ax.fill_between(trial, *band, color=look["color"], alpha=0.2, linewidth=0.0)
        ax.plot(trial, some.mean(axis=0), label=f"{length:g} m", **look)
    finish(ax, "cost η", "trial")
    legend(ax)
    return figure
