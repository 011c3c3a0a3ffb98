"""Figure of the excess cost against trials, and of unsafe trials."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estune.support import plot_style
from experiments.sample_efficiency.algorithms import ALGORITHMS
from experiments.sample_efficiency.figures import DEFAULT, NOISE
from experiments.sample_efficiency.problems import PROBLEMS
from experiments.sample_efficiency.searches import COLD, NEAR, Row, select

COLOURS = {
    "model_based": "#000000",
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
    "TPE from the model": "#6baed6",
    "BOBYQA from the model": "#74c476",
    "CMA-ES from the model": "#80deea",
    "Nelder-Mead from the model": "#a5b0b8",
}
BANDS = (
    "model_based",
    "safe_bayesian",
    "Optuna TPE",
    "Py-BOBYQA",
)  # more quartiles would hide each other
EXCESS_MIN = 3e-4  # smaller values are drawn here


def save_figure(rows: Sequence[Row], path: Path) -> None:
    """Draws the rows at 3 % noise from the weak start, a panel for each problem."""
    usual = select(rows, noise=NOISE, start=COLD)
    problems = [name for name in PROBLEMS if select(usual, problem=name)]
    names = [name for name in ALGORITHMS if select(usual, algorithm=name)]
    columns = -(-len(problems) // 2)
    figure = plot_style.new_figure(3.3 * columns + 3.4, 6.8)
    grid = figure.add_gridspec(2, columns + 1, width_ratios=[1.0] * columns + [1.05])
    first = None
    for n, problem in enumerate(problems):
        cell = grid[n // columns, n % columns]
        panel = figure.add_subplot(cell, sharex=first, sharey=first)
        first = first or panel
        _draw_problem(panel, select(usual, problem=problem), names)
        panel.set_title(problem, fontsize=10)
        panel.tick_params(labelleft=n % columns == 0, labelbottom=n >= len(problems) - columns)
        if n % columns == 0:
            panel.set_ylabel("excess over the optimum's cost")
        if n >= len(problems) - columns:
            panel.set_xlabel("trial")
    _draw_unsafe(figure.add_subplot(grid[:, -1]), usual, names)
    figure.suptitle(
        f"Recommended gains after each trial, noise {NOISE:.0%}: median of the seeds, "
        f"quartiles of {', '.join(BANDS)}",
        fontsize=11,
    )
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(plot_style.to_png(figure, dpi=110))


def _draw_problem(panel: Any, rows: Sequence[Row], names: Sequence[str]) -> None:
    for name in names:
        mine = select(rows, algorithm=name)
        if not mine:
            continue
        excess = np.maximum([row.excess for row in mine], EXCESS_MIN)
        trials = np.arange(1, excess.shape[1] + 1)
        lower, middle, upper = np.quantile(
            excess, (0.25, 0.5, 0.75), axis=0, method="closest_observation"
        )
        ours = name == DEFAULT
        width, order = (2.4, 5) if ours else (1.1, 3)
        panel.plot(trials, middle, color=COLOURS[name], linewidth=width, zorder=order)
        if name in BANDS:
            panel.fill_between(
                trials, lower, upper, color=COLOURS[name], alpha=0.18, linewidth=0.0
            )
    panel.axhline(NEAR, color="k", linewidth=0.7, linestyle=":")
    panel.set(xscale="log", yscale="log", ylim=(EXCESS_MIN, 12.0), xlim=(3, 200))
    panel.set_xticks([5, 10, 20, 50, 100, 200], ["5", "10", "20", "50", "100", "200"])
    levels = {1e-3: "0.1 %", 1e-2: "1 %", NEAR: "5 %", 0.1: "", 1.0: "100 %", 10.0: "1000 %"}
    panel.set_yticks(list(levels), list(levels.values()))
    panel.minorticks_off()


def _draw_unsafe(panel: Any, rows: Sequence[Row], names: Sequence[str]) -> None:
    """Unsafe trials: a dot for each search, a bar at the median, and the names of the colours."""
    for place, name in enumerate(names):
        mine = select(rows, algorithm=name)
        counts = np.array([row.unsafe for row in mine])
        # Spaced by the golden section, so that equal counts do not form lines.
        spread = 0.2 * ((np.arange(len(counts)) * 0.618) % 1.0) + 0.1
        panel.plot(counts, place + spread, ".", color=COLOURS[name], markersize=3.5, alpha=0.45)
        middle = float(np.median(counts))
        panel.plot([middle] * 2, [place + 0.05, place + 0.35], color=COLOURS[name], linewidth=3)
        weight = "bold" if name == DEFAULT else "normal"
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
