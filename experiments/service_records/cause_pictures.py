"""What does each cause of a restless loop look like?

Command: `python -m experiments.service_records.cause_pictures --out docs/images`.
Target: none; it draws `cause_NAME.png` for `docs/how-to/logs.md`.

Of simulated loops of each cause the first that is told clearly.
"""

import sys

from estune.service_records.cause.judge import Cause, judge_signals
from estune.service_records.cause.loop_signals import JudgedSignals, swings
from estune.service_records.cause.page import draw_plane, draw_spectrum, draw_time
from estune.support.plot_style import new_figure, to_png
from experiments.results import command_line
from experiments.service_records.loops import CAUSES, draw

CLEAR, SWINGS = 0.7, 6
"""Least probability of a cause, and swings of the output of one that swings."""


def clear(cause: str) -> Cause:
    """The first simulated loop of a cause that is told clearly."""
    for seed in range(300):
        log = draw(seed, cause)
        signals = JudgedSignals(log.setpoint, log.measurement, log.output, 1.0)
        found = judge_signals(signals)
        few = cause not in ("sensor", "none") and len(swings(log.output)) < SWINGS
        few |= found.numbers.get("direction") == "slow"
        if found.name == cause and found.probability >= CLEAR and not few:
            return found
    raise RuntimeError(f"no loop of seeds 0 to 299 shows {cause} clearly")


def picture(cause: Cause) -> bytes:
    """Time on the left, output against measurement and spectrum on the right, as PNG."""
    figure = new_figure(9.0, 3.2)
    grid = figure.add_gridspec(2, 3)
    above = figure.add_subplot(grid[0, 0])
    below = figure.add_subplot(grid[1, 0], sharex=above)
    assert cause.shown is not None  # noqa: S101  it was judged
    draw_time(cause, cause.shown, above, below)
    draw_plane(cause, cause.shown, figure.add_subplot(grid[:, 1]))
    draw_spectrum(cause.shown, figure.add_subplot(grid[:, 2]))
    return to_png(figure)


def main() -> int:
    """Draws the pictures."""
    parser = command_line(__doc__, quick="the sticking actuator alone", out="the pictures")
    options = parser.parse_args()
    folder = options.out
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("sticking",) if options.quick else CAUSES:
        found = clear(name)
        (folder / f"cause_{name}.png").write_bytes(picture(found))
        print(found.heading())
    return 0


if __name__ == "__main__":
    sys.exit(main())
