"""`estune suggest`: margins and better gains from records of a running loop."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

from cyclopts import Parameter

from estune.cli import output
from estune.cli.options import NO_LIMITS, LimitOptions
from estune.cli.stated_controller import stated_controller
from estune.cli.values import (
    Flag,
    Json,
    Quiet,
    Values,
    check_folder_exists,
    command_line,
    words_from,
)
from estune.errors import InvalidInput
from estune.support.quantity_text import time_text

if TYPE_CHECKING:
    from estune.core.controller_form import ControllerForm
    from estune.service_records.suggestion import GainsUnknown, Suggestion

_CAUSES = {"none": "bold green", "sticking": "bold red", "sensor": "bold red"}


def suggest(
    records: tuple[Path, ...],
    /,
    *,
    gains: Annotated[str | None, Parameter(show_default=False)] = None,
    map_: Annotated[Values, Parameter(name="--map")] = (),
    sampling_Hz: Annotated[float | None, Parameter(name="--sampling")] = None,
    derivative_filter_s: Annotated[float | None, Parameter(name="--derivative-filter")] = None,
    form: Values = (),
    reverse: Flag = False,
    settling_time_s: Annotated[float | None, Parameter(name="--settling")] = None,
    step: float | None = None,
    cost: str | None = None,
    limits: LimitOptions = NO_LIMITS,
    report: Path | None = None,
    next_: Annotated[Path | None, Parameter(name="--next")] = None,
    quiet: Quiet = False,
    json: Json = False,
) -> int:
    """Judge the gains of a running loop by its records, and recommend better ones.

    Args:
        records: Logs of one loop, folders of them, or a run, in any format of estune records. No
            steps are needed. Gains in use: those of the last log.
        gains: The gains that ran, such as "P=1.2,I=40,D=0.01,F=0.005": of P e + I int(e) - D
            dy/dt, F the setpoint filter in s. Or a TOML file: a rig's, or one with the gains of
            each log, [gains."run1.csv"]. By default those in the metadata of the records.
        map_: Channels: time=t,setpoint=sp,measurement=pv,effort=out.
        sampling_Hz: Sampling rate, where the records have no times.
        derivative_filter_s: Time constant of the derivative filter, s.
        form: Form of the controller, such as integral=backward,derivative_on=error.
        reverse: More effort lowers the measurement.
        settling_time_s: Settling time asked for, s; that of the gains in use by default.
        step: Step that the predictions are for; the range of the setpoint by default.
        cost: What the gains minimise: paper (the default), itae, ise, or module:function.
        limits: What the recommended gains keep.
        report: Write a report as one HTML page that works offline.
        next_: Folder for the trial that would show what these records do not, for estune
            run-experiment.

    The first line says whether it is the tuning, the actuator, the sensor or something outside;
    without gains it comes alone. Exits with 9 where the records do not show enough, and with 10
    where other gains ran than those stated.

    Raises:
        InvalidInput: no record can be used, or an option cannot be read.
    """
    check_folder_exists("--report", report)
    from estune.run.progress import showing_phases  # noqa: PLC0415  slow to import
    from estune.service_records import suggestion as service  # noqa: PLC0415  as above

    stated = stated_controller(gains)
    try:
        with showing_phases(quiet=quiet) as progress:
            found = service.suggest(
                records,
                gains=stated.gains,
                columns=words_from("--map", map_),
                sampling_Hz=sampling_Hz,
                derivative_filter_s=(
                    stated.derivative_filter_s
                    if derivative_filter_s is None
                    else derivative_filter_s
                ),
                form=_form(form),
                reverse=reverse,
                settling_time_s=settling_time_s,
                step=step,
                cost=cost,
                limits=limits.limits,
                progress=progress,
            )
    except service.GainsUnknown as error:
        return _cause_alone(error, report, json=json)
    if report is not None:
        found.report(report)
    trial = _written(found, next_) if next_ is not None else None
    if json:
        output.print_json(found.to_json())
    else:
        _show(found, report, trial)
    return found.exit_code


def _cause_alone(error: "GainsUnknown", report: Path | None, *, json: bool) -> int:
    """The cause without margins, and what margins would need."""
    cause = error.cause
    if report is not None:
        from estune.service_records.cause.page import page  # noqa: PLC0415  slow to import
        from estune.support import html_page  # noqa: PLC0415  as above

        html_page.write(page(cause), report)
    if json:
        found = {"verdict": "no gains", "heading": cause.heading(), "reason": str(error)}
        output.print_json({**found, "cause": cause.to_json()})
    else:
        output.show_line(cause.heading(), _CAUSES.get(cause.name, "bold yellow"))
        output.show_line(f"No gains are judged: {error}.")
        if report is not None:
            output.show_next({"report": report})
    return 9 if cause.name == "unknown" else 0


def _form(texts: Values) -> "ControllerForm | None":
    """The form of the controller; None where nothing is said of it.

    Raises:
        InvalidInput: there is no such property, or no such value.
    """
    given = words_from("--form", texts)
    if not given:
        return None
    from estune.core.controller_form import ControllerForm  # noqa: PLC0415  of no use to other commands

    hints = get_type_hints(ControllerForm)
    for name, value in given.items():
        if name not in hints:
            raise InvalidInput(f"--form has no {name}; it has {', '.join(hints)}")
        if value not in get_args(hints[name]):
            known = ", ".join(get_args(hints[name]))
            raise InvalidInput(f"--form {name}={value}: give one of {known}")
    # The values were checked against the types above.
    values: dict[str, Any] = {**given}
    return ControllerForm(**values)


def _written(found: "Suggestion", folder: Path) -> Path | None:
    return None if found.experiment is None else found.experiment.trial.write(folder)


def _show(found: "Suggestion", report: Path | None, trial: Path | None) -> None:
    output.show_doubts(found.issues)
    lines = [(found.heading(), "bold green" if found.exit_code == 0 else "bold yellow")]
    if found.cause is not None:
        style = _CAUSES.get(found.cause.name, "bold yellow")
        lines.insert(1 if found.verdict_first else 0, (found.cause.heading(), style))
    for text, style in lines:
        output.show_line(text, style)
    for sentence in found.remarks():
        output.show_line(sentence)
    print()
    output.show_table(("", "in use", "recommended"), found.rows())
    print()
    used = sum(s.samples for s in found.stretches) / found.trial.controller.sampling_Hz
    count = len(found.stretches)
    stretches = f"{count} stretch{'es' if count > 1 else ''}"
    facts: dict[str, object] = {
        "used": f"{time_text(used)} in {stretches}, "
        f"a sample every {time_text(1.0 / found.trial.controller.sampling_Hz)}"
    }
    for part in found.left_out:
        facts[f"not used, {part.log} {part.start_s:.4g} to {part.stop_s:.4g} s"] = part.reason
    if report is not None:
        facts["report"] = report
    if trial is not None:
        facts["next trial"] = command_line("run-experiment", trial, "RIG")
    elif found.experiment is not None:
        facts["next trial"] = "--next FOLDER writes it for estune run-experiment"
    output.show_next(facts)
    for issue in found.issues:
        if issue.level == "doubt":
            continue  # said above
        output.show_issue(issue.level, str(issue))
