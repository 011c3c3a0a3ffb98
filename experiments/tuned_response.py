"""What does a tuning change in the step response and the control effort?

Command: `python -m experiments.tuned_response`.
Target: none; a figure.
"""

import sys

import estune
import plants
from estune.run.results.result import TuneResult
from estune.support.plot_style import BLACK, BLUE, GREY, VERMILION, finish, legend, stacked
from experiments.results import command_line, print_results, save_figure


def tune(cable_length_m: float) -> TuneResult:
    """A tuning of the reference reel, from its safe gains."""
    reel = plants.reference_reel(cable_length_m=cable_length_m)
    return estune.tune(reel, trials=120, journal=False, watch=None)


def main() -> int:
    """Prints gains and cost before and after, and draws the figure."""
    options = command_line(__doc__, quick="nothing", out="the figure").parse_args()
    result = tune(cable_length_m=0.8)
    records = (result.first_record, result.tuned_record)
    figure, (response, effort) = stacked(2, 4.2)
    for record, name, color in zip(records, ("before", "after"), (VERMILION, BLUE), strict=True):
        if record is None:
            continue
        time_ms = 1e3 * (record.time_s - result.plan.step.step_at_s)
        if name == "before":
            response.plot(time_ms, record.setpoint_N, color=GREY, linewidth=0.9, label="setpoint")
        response.plot(time_ms, record.tension_N, color=color, linewidth=1.2, label=name)
        effort_N = record.current_A * result.rig.newtons_per_ampere
        effort.plot(time_ms, effort_N, color=color, linewidth=1.0)
    response.axvline(0.0, color=BLACK, linewidth=0.5)
    response.set_xlim(-50.0, 600.0)
    finish(response, "tension (N)")
    finish(effort, "control effort (N)", "time from the step (ms)")
    legend(response)
    path = save_figure(figure, options.out, "tuned_response")
    figures = {
        "gains_before": result.start_gains.as_tuple(),
        "gains_after": result.gains.as_tuple(),
        "cost_change": None if result.improvement is None else result.improvement.estimate,
        "trials": result.nfev,
        "unsafe": result.unsafe,
    }
    if not options.json:
        print(f"before: {result.start_gains}\nafter:  {result.gains}")
        print(f"{result.message}\nfigure: {path}")
    return print_results(figures, {}, as_json=options.json)


if __name__ == "__main__":
    sys.exit(main())
