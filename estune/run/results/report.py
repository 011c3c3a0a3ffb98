"""Report page of a tuning: what to do, how the response changed, and what that rests on."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from itertools import zip_longest
from typing import Any

import numpy as np

from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES
from estune.loop_model.optimum import RobustnessLimits
from estune.run.results import figures
from estune.run.results.frequency_figures import (
    PlantResponse,
    loop_drawings,
    response_columns,
)
from estune.run.results.run_result import RunResult
from estune.run.results.sentences import claimed_robustness, response_changes
from estune.run.results.tuning_data import tuning_data
from estune.support.html_page import (
    Block,
    Drawing,
    Page,
    Panel,
    Paragraph,
    Section,
    Status,
    Table,
    Warnings,
)
from estune.support.plot_style import new_figure
from estune.support.quantity_text import time_text
from estune.trial import TrialRecord
from estune.trial.profiles import LoadStepProfile

_CSV_MAX = 400_000
"""Characters of a table that the page carries: three of them are 1.6 MB as base64, and a page is
to stay below 1.5 MB. `estune export` writes all samples."""

CHART_FILES = ("colours.css", "uPlot.min.css", "uPlot.iife.min.js", "charts.js")
TUNER_FILES = ("tuner.css", "loop.js", "optimum.js", "gains.js", "nyquist.js", "tuner.js")

_FAR = 1e4
"""Times the largest command up to which a limit is worth naming."""


def page(result: RunResult) -> Page:
    """The page of a tuning, finished or not."""
    return Page(
        f"Tuning of {result.rig.name}",
        Status(_recommendation(result), good=result.ending.good),
        (
            *(() if result.success else (Paragraph(result.remarks()[0], style="lead"),)),
            _before_and_after(result),
            Warnings(result.remarks()[1:]),
        ),
        (
            Section("Step response", tuple(_responses(result))),
            Section("Disturbance response", tuple(_disturbance(result))),
            Section("Loop", tuple(_loop(result))),
            Section("Tune by the model", tuple(_tuning(result))),
            Section("Search", tuple(_search(result))),
            Section("Settings", (Table((), tuple(_settings(result).items())),)),
        ),
    )


def _recommendation(result: RunResult) -> str:
    gains = result.rig.gains_text(result.gains)
    if result.success:
        cost = f"{result.verdict.start_cost:.3g} to {result.verdict.cost:.3g}"
        shown = ", ".join(response_changes(result.start, result.tuned))
        fall = f"the cost falls from {cost}, {result.improvement}"
        if result.limits is None or not result.limits.reason:
            robust = claimed_robustness(result.claim, result.limits)
            return f"Use {gains}: {', '.join(filter(None, (shown, robust)))}; {fall}."
        return (
            f"{result.ending.capitalize()}: {result.limits.reason}. With {gains}: {shown}; {fall}."
        )
    return f"{result.ending.capitalize()}: keep {gains}."


def _before_and_after(result: RunResult) -> Table:
    if result.tuned:
        return Table(("", "Initial gains", "Tuned gains"), result.rows(), numeric=(1, 2))
    return Table(("", "Initial gains"), [row[:2] for row in result.rows()], numeric=(1,))


def _responses(result: RunResult) -> Iterator[Block]:
    before, after = result.first_record, result.tuned_record if result.success else None
    if before is None:
        yield Paragraph("No trial has been completed.")
        return
    rig, step = result.rig, result.plan.step
    figure = new_figure(7.2, 5.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    figures.draw_response(upper, step, before, after, rig.measurement)
    upper.set_xlabel("")
    figures.draw_command(lower, step, rig, before, after)
    shown = {"initial": before} | ({"tuned": after} if after is not None else {})
    load = " The load of the disturbance response begins at the dotted line."
    load = load if isinstance(step, LoadStepProfile) else ""
    yield Drawing(
        figure,
        "response",
        f"{rig.measurement_name} and {rig.command_name} over time, before and after",
        f"{rig.measurement_name.capitalize()} and {rig.command_name} in the first trial with the "
        f"initial gains{' and the last with the tuned ones' if after is not None else ''}."
        f"{load}{_limits(result, before)}",
        csv=_csv(_samples(shown, rig.newtons_per_ampere)),
    )


def _disturbance(result: RunResult) -> Iterator[Block]:
    """The response to the load of the trials, or else the predicted one to a load step."""
    rig, step, before = result.rig, result.plan.step, result.first_record
    if before is None:
        return
    if not isinstance(step, LoadStepProfile):
        yield from _predicted_disturbance(result)
        return
    after = result.tuned_record if result.success else None
    figure = new_figure(7.2, 2.8)
    figures.draw_disturbance(figure.add_subplot(), step, rig, before, after)
    load = rig.commanded(step.load_N)
    yield Drawing(
        figure,
        "disturbance",
        f"Deviation of the {rig.measurement_name} from its setpoint after a load",
        f"{rig.measurement_name.capitalize()} less its setpoint after a load of {load} at the "
        f"plant's input, in the trials of the step response; the numbers are in that figure's "
        "data. The grey band is that of the settling and the recovery time.",
    )


def _predicted_disturbance(result: RunResult) -> Iterator[Block]:
    """The response of the identified loop to a load step; nothing where it is not known."""
    rig, known = result.rig, [at for at in result.rejections.values() if at is not None]
    if not known:
        return
    figure = new_figure(7.2, 2.8)
    figures.draw_rejections(figure.add_subplot(), result.rejections, result.plan.step.step_N, rig)
    yield Drawing(
        figure,
        "disturbance",
        f"Predicted deviation of the {rig.measurement_name} after a load step",
        f"Predicted by the identified loop: {rig.measurement_name} less its setpoint after a load "
        f"step of {rig.commanded(abs(known[0].load), 3)} at the plant's input, which without "
        "control would move it by the step.",
    )


def _limits(result: RunResult, record: TrialRecord) -> str:
    """Limits of the command in a sentence; empty where they are far from all that is commanded."""
    rig = result.rig
    low, high = rig.controller.output_min_N, rig.controller.output_max_N
    used = float(np.abs(record.current_A).max(initial=0.0)) * rig.newtons_per_ampere
    if max(abs(low), abs(high)) > _FAR * max(used, abs(result.plan.step.step_N)):
        return ""
    name = rig.command_name
    return f" The {name} is limited to {low:.4g} to {rig.commanded(high)}."


def _samples(records: Mapping[str, TrialRecord], per_ampere: float) -> dict[str, Any]:
    """Columns of the records; those of the shorter one end with NaN."""
    columns: dict[str, Any] = {}
    for label, record in records.items():
        columns |= {
            f"{label}_time_s": record.time_s,
            f"{label}_setpoint": record.setpoint_N,
            f"{label}_measurement": record.tension_N,
            f"{label}_command": record.current_A * per_ampere,
        }
    return columns


def _loop(result: RunResult) -> Iterator[Block]:
    """Bode and Nyquist figures of the loop, or why there are none."""
    rig, claim = result.rig, result.claim
    response = PlantResponse.of_loop(claim, result.identified.fit, rig)
    if claim.margins is not None:
        known = (
            "The loop is identified from the run's own records; its linear model leaves "
            f"{claim.misfit:.2%} of the step unexplained. The band and the pale curves are models "
            "that the records allow with 95 %."
        )
    else:
        known = (
            "The loop is the rig's own linear model of its plant, whose accuracy is not known; "
            f"the records allow no statement: {claim.reason}."
        )
    if response is None:
        yield Paragraph(f"There is no model of the loop: {claim.reason}.")
        return
    loops = result.loops
    yield Paragraph(known)
    csv = _csv(response_columns(response, rig.controller, loops))
    yield from loop_drawings(response, rig.controller, loops, result.sensitivity_limit, csv)


def _tuning(result: RunResult) -> Iterator[Block]:
    """The sliders of the live page, where a loop was identified."""
    data = tuning_data(result)
    if data is not None:
        yield Panel(
            "tuner",
            "Move the sliders: nothing here acts on the rig. Try gains there with `estune watch`.",
            data,
            (
                *(("estune.support", f"charts/{name}") for name in CHART_FILES),
                *(("estune.loop_model", f"browser/{name}") for name in TUNER_FILES),
            ),
            "new Tuner(element, data);",
        )


def _search(result: RunResult) -> Iterator[Block]:
    if not result.entries:
        return
    columns = result.columns()
    figure = new_figure(7.2, 5.4)
    upper, lower = figure.subplots(2, 1, sharex=True)
    result.plot_cost(upper)
    upper.set_xlabel("")
    result.plot_gains(lower)
    names = ["number", "phase", *GAIN_NAMES, "cost", "best_cost", "unsafe", "outcome"]
    yield Drawing(
        figure,
        "search",
        "Cost and gains over the trials",
        f"{result.verdict.message[:1].upper()}{result.verdict.message[1:]}. The lowest "
        "cost of a search may be luck, so repeats after it compare the gains. Behind the last "
        "trial: the gains of the result with their intervals.",
        csv=_csv({name: columns[name] for name in names}),
    )


def _settings(result: RunResult) -> dict[str, str]:
    """The plan and the rig by label."""
    plan, rig = result.plan, result.rig
    step = plan.step
    rows = {
        "run": plan.run,
        "step": f"{rig.step_text(step)} at {time_text(step.step_at_s)} of "
        f"{time_text(step.duration_s)}",
        "cost": ", ".join(_cost(plan.cost)),
        "unsafe above": f"η = {result.session.eta_max:.3g}",
        "trials": result.trials_text,
        "limits": _limits_asked(plan.limits),
        "ends below": f"{plan.tolerance:.3g} remaining improvement",
        "tuner": _tuner(plan.tuner),
        "rig": ", ".join(
            (
                rig.name,
                f"{rig.controller.sampling_Hz:.4g} Hz",
                *((f"cable {rig.cable_length_m:g} m",) if rig.cable_length_m else ()),
                "simulated" if rig.simulated else "hardware",
            )
        ),
        "its program": rig.software or "not stated",
    }
    first = result.first_record
    return rows if first is None else {**rows, "began": first.started_at}


def _limits_asked(limits: RobustnessLimits | None) -> str:
    if limits is None:
        return "none"
    shown = (
        (limits.max_sensitivity, "Ms up to {:g}"),
        (limits.max_overshoot, "overshoot up to {:.3%}"),
        (limits.min_phase_margin_deg, "phase margin from {:g}°"),
    )
    texts = [form.format(value) for value, form in shown if value is not None]
    return ", ".join(texts).replace(".000%", " %") or "none"


def _cost(cost: StepCost) -> Iterator[str]:
    if cost.function:
        yield cost.function
        return
    yield {"paper": "(35)", "itae": "ITAE", "ise": "ISE"}[cost.criterion]
    yield f"settling time {time_text(cost.settling_time_s)}"
    if cost.criterion == "paper":
        unit = "s" if cost.time_unit == "second" else "settling times"
        yield from (f"weight {cost.weight}", f"time in {unit}")
    yield f"control-move penalty {cost.move_weight:g}"
    if cost.effort_weight:
        yield f"price of the effort {cost.effort_weight:g}"
    if cost.rejection:
        yield f"load rejection {cost.rejection:.0%}"


def _tuner(tuner: Any) -> str:
    """Name of a tuner and those of its settings that are numbers or names."""
    if not dataclasses.is_dataclass(tuner) or not hasattr(tuner, "name"):
        return str(getattr(tuner, "name", type(tuner).__name__))
    shown = {f.name: getattr(tuner, f.name) for f in dataclasses.fields(tuner)}
    settings = [
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in shown.items()
        if name != "name" and isinstance(value, int | float | str)
    ]
    return ", ".join([shown["name"], *settings])


def _csv(columns: Mapping[str, Any]) -> str:
    """Columns as CSV, shorter ones filled up with nothing; empty where it is too long."""
    lists = (map(_text, np.asarray(values).tolist()) for values in columns.values())
    rows = (columns, *zip_longest(*lists, fillvalue=""))
    text = "".join(f"{','.join(row)}\n" for row in rows)
    return text if len(text) <= _CSV_MAX else ""


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return str(value)
