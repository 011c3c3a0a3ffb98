"""`estune explain`: where a model and records disagree, and which effect would explain it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from estune.cli import output
from estune.errors import InvalidInput

if TYPE_CHECKING:
    from plants.diagnosis.report.diagnosis import Diagnosis
    from plants.diagnosis.report.summary import Table as Rows

_Flag = Parameter(negative=(), show_default=False)

_LOOKS = {"named": "bold green", "none": "bold green"}
_BEST = 5


def explain(
    *,
    model: str,
    data: Path,
    json: Annotated[bool, _Flag] = False,
    report: Path | None = None,
    save: Path | None = None,
    next_: Annotated[Path | None, Parameter(name="--next")] = None,
    effects: Annotated[
        tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)
    ] = (),
) -> None:
    """Find where a model and measured records disagree, and name the missing effect.

    Args:
        model: The model: a file such as reel.toml, or module:attribute such as
            plants:reference_reel or plants:unloaded_reel.
        data: Folder of records, CSV with JSON beside it or Parquet, as estune export writes them.
        json: Print JSON.
        report: Write everything as one HTML page, which needs no other file and no network.
        save: Write the model with the effects found as a model file.
        next_: Folder to write the trial that would decide into, for estune run-experiment.
        effects: Effects of your own that join the search, each as module:Class.

    Raises:
        InvalidInput: an option cannot be used; no record can, with the reason for each.
    """
    for option, path in (("--report", report), ("--save", save)):
        if path is not None and not path.parent.is_dir():
            raise InvalidInput(
                f"there is no folder {path.parent}; make it, or give another {option}"
            )
    import plants  # noqa: PLC0415  slow to import
    from plants.effects import declared, find  # noqa: PLC0415  slow to import

    own = tuple(map(find, effects))
    given = plants.load_model(model)
    with Console(stderr=True).status(f"{model} against the records of {data}"):
        found = plants.explain(given, data, effects=(*declared(), *own) if own else None)
    if report is not None:
        found.report(report)
    if save is not None:
        found.save(save, plant=model)
    trial = None
    if next_ is not None and found.next_experiment is not None:
        trial = found.next_experiment.write(next_)
    if json:
        output.print_json(found.to_json())
    else:
        _show(found)
        again = f"estune explain --model {model} --data {data}"
        facts: dict[str, object] = {"report": report or f"{again} --report report.html"}
        if save is not None:
            facts |= {"model": save, "try it": f"estune tune {save}"}
        if found.next_experiment is not None:
            run = f"estune run-experiment {trial} RIG --data {data}"
            facts["next trial"] = run if trial else f"{again} --next ."
        output.show_next(facts)


def _show(found: "Diagnosis") -> None:
    from plants.diagnosis.report import summary  # noqa: PLC0415  slow to import

    out = output.console()
    out.print(Text(found.heading(), style=_LOOKS.get(found.verdict, "bold yellow")))
    for text in summary.sentences(found):
        out.print(Text(text), soft_wrap=True)
    out.print()
    out.print(_table(summary.gaps(found)))
    if found.effects:
        out.print()
        out.print(_table(summary.parameters(found)))
    best = summary.fitted(found, _BEST)
    if best.rows:
        out.print()
        out.print(_table(best))
    out.print()
    if found.not_excited:
        names = f"{', '.join(found.not_excited)}; why is in the report"
        out.print(Text.assemble(("not excited  ", "dim"), names), soft_wrap=True)
    for finding in found.findings:
        look = "red" if finding.level == "refused" else "yellow"
        line = Text.assemble((f"{finding.level}  ", look), str(finding))
        out.print(line, soft_wrap=True)
    if found.next_experiment is not None:
        sentence = found.next_experiment.sentence
        out.print(Text.assemble(("next  ", "bold"), sentence), soft_wrap=True)


def _table(rows: "Rows") -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for number, column in enumerate(rows.columns):
        numeric = all(not row[number] or row[number][0] in "-0123456789" for row in rows.rows)
        side: Literal["left", "right"] = "right" if number and numeric else "left"
        table.add_column(column, header_style="dim", justify=side, no_wrap=True)
    for row in rows.rows:
        table.add_row(*map(Text, row))
    return table
