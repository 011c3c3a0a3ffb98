"""`estune explain`: the effect that is missing from a model, identified from records."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from rich.table import Table
from rich.text import Text

from estune.cli import output
from estune.cli.stated_controller import stated_controller
from estune.cli.values import Effects, Flag, Json, Quiet, Values, check_folder_exists, command_line
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.run.progress import showing_phases
from plants.commands.columns import Sources, column_map

if TYPE_CHECKING:
    from plants.diagnosis.report.diagnosis import Diagnosis
    from plants.diagnosis.report.summary import TextTable as Rows

EXAMPLE = Path(__file__).with_name("reel.toml")
_STYLES = {"named": "bold green", "none": "bold green"}
_CANDIDATES = 5
"""Candidates in the table."""


def explain(
    *,
    model: str | None = None,
    data: Path | None = None,
    json: Json = False,
    report: Path | None = None,
    save: Path | None = None,
    next_: Annotated[Path | None, Parameter(name="--next")] = None,
    export: Path | None = None,
    hold_out: Path | None = None,
    gains: str | None = None,
    effects: Effects = (),
    map_: Sources = (),
    unit: Values = (),
    scale: Values = (),
    save_map: Path | None = None,
    quiet: Quiet = False,
    example: Flag = False,
) -> int:
    """Identify the effect missing from a model, from records.

    Args:
        model: The model: a file such as reel.toml, or module:attribute such as
            plants:reference_reel or plants:unloaded_reel.
        data: Folder of records, as estune export writes them or in any format of estune records.
        report: Write a report as one HTML page that works offline.
        save: Write the model with the identified effects as a model file.
        next_: Folder for the trial that would distinguish the candidates, for estune
            run-experiment, or else for a table of what to record next.
        export: Write the identified joint for another simulator: MJCF (.xml), URDF (.urdf) or a
            table of the fields of Isaac Sim (.csv).
        hold_out: A record, or folder of records, that nothing is fitted to; its errors are
            reported.
        gains: Gains that remedies are predicted for, such as "P=1.2,I=40,D=0.01,F=0.005"; by
            default those of the records.
        effects: Effects of your own that join the search, each as module:Class.
        map_: Where the columns come from: time=t,current=vir,angle=qm, or a TOML file of them.
        unit: Their units, such as angle=mm,tension=lbf.
        scale: Factors to the unit, such as current=35.15.
        save_map: Write the map as a TOML file, for --map.
        example: Print a model file, of the reel that estune serve-hardware --example emulates, and
            exit.

    Exits with 9 where the records do not show enough for the verdict to stand alone, as motion
    in one direction only, and with 10 where data have faults to be corrected first.

    Raises:
        InvalidInput: an option cannot be used, or no record can, with the reason for each.
    """
    if example:
        print(EXAMPLE.read_text("utf-8"), end="")
        return 0
    if model is None or data is None:
        missing = "--model" if model is None else "--data"
        raise InvalidInput(f"{missing} is missing; for a model file to begin from, use --example")
    check_folder_exists("--report", report)
    check_folder_exists("--save", save)
    check_folder_exists("--export", export)
    import plants  # noqa: PLC0415  slow to import
    from plants.effects import declared, find  # noqa: PLC0415  slow to import
    from plants.joint_export import check_export  # noqa: PLC0415  slow to import
    from plants.joint_export import export as export_joint  # noqa: PLC0415  as above

    own, asked = tuple(map(find, effects)), stated_controller(gains).gains
    if asked is not None and not isinstance(asked, Gains):
        raise InvalidInput("--gains: gains of several logs; remedies are predicted for one set")
    columns = column_map(map_, unit, scale, save_map)
    given = plants.load_model(model)
    if export is not None:
        check_export(given, export)
    with showing_phases(quiet=quiet) as progress:
        diagnosis = plants.explain(
            given,
            data,
            effects=(*declared(), *own) if own else None,
            columns=columns,
            hold_out=hold_out,
            progress=progress,
        )
    diagnosis = replace(diagnosis, gains=asked or diagnosis.gains)
    if json:  # before anything is written: a full disk must not cost the verdict
        output.print_json(diagnosis.to_json())
    else:
        _show(diagnosis)
    if export is not None:
        export_joint(diagnosis, export)
    trial, table = _written(diagnosis, model, report, save, next_)
    if not json:
        again = partial(command_line, "explain", model=model, data=data)
        facts: dict[str, object] = {"report": report or again(report="report.html")}
        if diagnosis.next_recording is not None and diagnosis.next_recording.columns:
            facts["next recording"] = table or again(next=".")
        output.show_next(facts | _next_steps(diagnosis, save, trial, again, data))
    return diagnosis.exit_code


def _written(
    diagnosis: "Diagnosis",
    model: str,
    report: Path | None,
    save: Path | None,
    folder: Path | None,
) -> tuple[Path | None, Path | None]:
    """Writes the files that were asked for; those of the next trial and the next recording."""
    if report is not None:
        diagnosis.report(report)
    if save is not None:
        diagnosis.save(save, plant=model)
    following, recording = diagnosis.next_experiment, diagnosis.next_recording
    trial = None if folder is None or following is None else following.write(folder)
    table = None if folder is None or recording is None else recording.write(folder)
    return trial, table


def _next_steps(
    diagnosis: "Diagnosis",
    save: Path | None,
    trial: Path | None,
    again: Callable[..., str],
    data: Path,
) -> dict[str, object]:
    """Commands that come next: of the saved model, and of the trial that would decide."""
    facts: dict[str, object] = {}
    if save is not None:
        facts["model"] = save
        if can_be_tuned(diagnosis.augmented):
            facts["try it"] = command_line("tune", save)
    if diagnosis.next_experiment is not None:
        run = command_line("run-experiment", trial, "RIG", data=data)
        facts["next trial"] = run if trial else again(next=".")
    return facts


def can_be_tuned(model: Any) -> bool:
    """Whether a model has a tension, or another output, to be controlled."""
    return bool(model.profile.loop == "closed")


def _show(diagnosis: "Diagnosis") -> None:
    from plants.diagnosis.report import summary  # noqa: PLC0415  slow to import
    from plants.remedies import text as remedies  # noqa: PLC0415  as above

    out = output.console()
    output.show_doubts(diagnosis.findings)
    out.print(Text(diagnosis.heading(), style=_STYLES.get(diagnosis.verdict, "bold yellow")))
    for text in summary.sentences(diagnosis):
        output.show_line(text)
    out.print()
    out.print(_table(summary.gaps(diagnosis)))
    if diagnosis.effects:
        out.print()
        out.print(_table(summary.parameters(diagnosis)))
    offers = diagnosis.remedies()
    if offers:
        out.print()
        columns = ("what can be done", *remedies.COLUMNS[1:])
        out.print(_table(summary.TextTable(columns, remedies.rows(offers))))
    for text in remedies.sentences(diagnosis, offers):
        output.show_line(text)
    best = summary.fitted(diagnosis, _CANDIDATES)
    if best.rows:
        out.print()
        out.print(_table(best))
    out.print()
    for head, names, why in _not_shown(diagnosis):
        out.print(Text.assemble((f"{head}  ", "dim"), f"{names}{why}"), soft_wrap=True)
    for issue in diagnosis.findings:
        output.show_issue(issue.level, str(issue))
    following = diagnosis.next_experiment or diagnosis.next_recording
    if following is not None:
        sentence = following.sentence
        out.print(Text.assemble(("next  ", "bold"), sentence), soft_wrap=True)


def _not_shown(diagnosis: "Diagnosis") -> Iterator[tuple[str, str, str]]:
    """Effects that were not looked for: of the records, and of the model where no effect helps."""
    from plants.diagnosis.report import summary  # noqa: PLC0415  slow to import

    if diagnosis.hidden:
        yield "not excited", ", ".join(diagnosis.hidden), "; why is in the report"
    if diagnosis.verdict not in _STYLES:
        for names, why in summary.not_tried(diagnosis):
            yield "not tried", names, f": {why}"


def _table(rows: "Rows") -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for number, column in enumerate(rows.columns):
        side: Literal["left", "right"] = "right" if number in rows.numeric else "left"
        table.add_column(column, header_style="dim", justify=side, no_wrap=True)
    for row in rows.rows:
        table.add_row(*map(Text, row))
    return table
