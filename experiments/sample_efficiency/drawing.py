"""The figure: excess of what would be settled on against trials, and unsafe trials beside it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.sample_efficiency.algorithms import ALGORITHMS
from experiments.sample_efficiency.figures import NEWTON, NOISE
from experiments.sample_efficiency.problems import PROBLEMS
from experiments.sample_efficiency.searches import COLD, NEAR, Row, of

COLOURS = {
    "safe_bayesian": "#c1272d",
    "phase_compensated": "#e08214",
    "least_squares_gradient": "#b8860b",
    "otis": "#7f5539",
    "killingsworth": "#bdbdbd",
    "Xopt's ES": "#8c8c8c",
    "Optuna TPE": "#1b6ca8",
    "Py-BOBYQA": "#2a9d5c",
    "skopt GP": "#6a3d9a",
    "CMA-ES": "#17a2b8",
    "Nelder-Mead": "#5c6b73",
    "SPSA": "#d670ad",
}
BANDS = ("safe_bayesian", "Optuna TPE", "Py-BOBYQA")  # more quartiles than these hide each other
LEAST = 3e-4  # what is nearer to the optimum than this is drawn here


def save_figure(rows: Sequence[Row], path: Path) -> None:
    """Draws the rows at 3 % noise from the weak start, a panel for each problem."""
    import matplotlib as mpl  # noqa: PLC0415  slow to import

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  after the backend is chosen

    usual = of(rows, noise=NOISE, start=COLD)
    problems = [name for name in PROBLEMS if of(usual, problem=name)]
    names = [name for name in ALGORITHMS if of(usual, algorithm=name)]
    columns = -(-len(problems) // 2)
    figure = plt.figure(figsize=(3.3 * columns + 3.4, 6.8), layout="constrained")
    grid = figure.add_gridspec(2, columns + 1, width_ratios=[1.0] * columns + [1.05])
    first = None
    for n, problem in enumerate(problems):
        cell = grid[n // columns, n % columns]
        panel = figure.add_subplot(cell, sharex=first, sharey=first)
        first = first or panel
        _draw_problem(panel, of(usual, problem=problem), names)
        panel.set_title(problem, fontsize=10)
        panel.tick_params(labelleft=n % columns == 0, labelbottom=n >= len(problems) - columns)
        if n % columns == 0:
            panel.set_ylabel("excess over the optimum's cost")
        if n >= len(problems) - columns:
            panel.set_xlabel("trial")
    _draw_unsafe(figure.add_subplot(grid[:, -1]), usual, names)
    figure.suptitle(
        f"What each would settle on after so many trials, noise {NOISE:.0%}: median of the seeds, "
        f"quartiles of {', '.join(BANDS)}",
        fontsize=11,
    )
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_problem(panel: Any, rows: Sequence[Row], names: Sequence[str]) -> None:
    for name in names:
        mine = of(rows, algorithm=name)
        if not mine:
            continue
        excess = np.maximum([row.excess for row in mine], LEAST)
        trials = np.arange(1, excess.shape[1] + 1)
        lower, middle, upper = np.quantile(
            excess, (0.25, 0.5, 0.75), axis=0, method="closest_observation"
        )
        ours = name == NEWTON
        width, order = (2.4, 5) if ours else (1.1, 3)
        panel.plot(trials, middle, color=COLOURS[name], linewidth=width, zorder=order)
        if name in BANDS:
            panel.fill_between(
                trials, lower, upper, color=COLOURS[name], alpha=0.18, linewidth=0.0
            )
    panel.axhline(NEAR, color="k", linewidth=0.7, linestyle=":")
    panel.set(xscale="log", yscale="log", ylim=(LEAST, 12.0), xlim=(3, 200))
    panel.set_xticks([5, 10, 20, 50, 100, 200], ["5", "10", "20", "50", "100", "200"])
    levels = {1e-3: "0.1 %", 1e-2: "1 %", NEAR: "5 %", 0.1: "", 1.0: "100 %", 10.0: "1000 %"}
    panel.set_yticks(list(levels), list(levels.values()))
    panel.minorticks_off()


def _draw_unsafe(panel: Any, rows: Sequence[Row], names: Sequence[str]) -> None:
    """Unsafe trials of a search: a dot for each, a bar at the median; and the colours' names."""
    for place, name in enumerate(names):
        mine = of(rows, algorithm=name)
        counts = np.array([row.unsafe for row in mine])
        # Apart by a golden section, so that equal counts and families do not fall on lines.
        spread = 0.2 * ((np.arange(len(counts)) * 0.618) % 1.0) + 0.1
        panel.plot(counts, place + spread, ".", color=COLOURS[name], markersize=3.5, alpha=0.45)
        middle = float(np.median(counts))
        panel.plot([middle] * 2, [place + 0.05, place + 0.35], color=COLOURS[name], linewidth=3)
        weight = "bold" if name == NEWTON else "normal"
        panel.text(-0.2, place - 0.1, name, color=COLOURS[name], fontsize=9, fontweight=weight)
    ticks = [0, 1, 2, 5, 10, 20, 50, 200]
    panel.set_xscale("symlog", linthresh=2.0)
    panel.set_xticks(ticks, [str(n) for n in ticks])
    panel.minorticks_off()
    panel.set_yticks([])
    panel.set(ylim=(len(names) - 0.4, -0.5), xlim=(-0.4, 250.0))
    panel.set_xlabel("unsafe trials of a search; bar: median")
    panel.set_title("over 1.5 times the start's cost", fontsize=10)
    panel.grid(axis="x", alpha=0.3)
