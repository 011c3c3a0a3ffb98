"""`estune improve`: a rig's model found wanting, mended, and the rig tuned with it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.text import Text

from estune.cli import output
from estune.cli.values import security_from
from estune.errors import InvalidInput
from estune.run.targets import is_endpoint, open_target

if TYPE_CHECKING:
    from plants.diagnosis.improvement import Improvement

_Flag = Parameter(negative=(), show_default=False)


def improve(
    target: str,
    /,
    *,
    model: str | None = None,
    folder: Path | None = None,
    rounds: int = 6,
    model_trials: int = 120,
    trials: int = 40,
    repeats: int = 3,
    effects: Annotated[
        tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)
    ] = (),
    json: Annotated[bool, _Flag] = False,
    report: Path | None = None,
    save: Path | None = None,
    rig: str | None = None,
    security: Path | None = None,
    quiet: Annotated[bool, _Flag] = False,
) -> None:
    """Find what a rig's model lacks by experiment, add it, and tune the rig with what was learnt.

    Args:
        target: Where the rig is: an endpoint such as tcp/127.0.0.1:7447, a model file such as
            reel.toml, or module:attribute such as plants:reference_reel.
        model: The model to begin from: a model file or module:attribute; by default the reference
            reel at the rig's cable length, or the linear model the rig tells of itself.
        folder: Folder for records, trial files and the tuning's run; the time of day by default.
        rounds: Most rounds of measuring and explaining.
        model_trials: Greatest number of search trials on the improved model.
        trials: Greatest number of search trials on the rig.
        repeats: Trials of each gains whose cost is compared.
        effects: Effects of your own that join the search, each as module:Class.
        json: Print JSON.
        report: Write the last diagnosis as one HTML page.
        save: Write the improved model as a model file.
        rig: Name of the rig, where several answer at the endpoint.
        security: File that says who this is, where the rig asks; see docs/security.md.
        quiet: Show no progress.
    """
    for option, path in (("--report", report), ("--save", save)):
        if path is not None and not path.parent.is_dir():
            raise InvalidInput(
                f"there is no folder {path.parent}; make it, or give another {option}"
            )
    import plants  # noqa: PLC0415  slow to import
    from plants.diagnosis.improve_model import TuneOptions  # noqa: PLC0415  slow to import
    from plants.effects import declared, find  # noqa: PLC0415  slow to import

    own = tuple(map(find, effects))
    silent = quiet or json
    begin = None if model is None else plants.load_model(model)
    with open_target(target, rig, security_from(security)) as the_rig:
        found = plants.improve(
            the_rig,
            begin,
            folder=folder,
            effects=(*declared(), *own) if own else None,
            rounds=rounds,
            tuning=TuneOptions(
                model_trials=model_trials,
                rig_trials=trials,
                repeats=repeats,
                watch=None if silent else "auto",
            ),
            say=(lambda _: None) if silent else output.console().print,
        )
    if report is not None:
        found.diagnosis.report(report)
    if save is not None:
        plants.save_model(found.model, save)
    if json:
        output.print_json(found.to_json())
        return
    _show(found)
    facts: dict[str, object] = {"records": found.folder / "data"}
    if found.tuning is not None and is_endpoint(target):
        facts["make live"] = f"estune apply {found.tuning.folder} {target}"
    if save is not None:
        facts |= {"model": save, "try it": f"estune tune {save}"}
    output.show_next(facts)


def _show(found: "Improvement") -> None:
    from plants.diagnosis.improvement import COLUMNS  # noqa: PLC0415  slow to import

    out = output.console()
    out.print()
    out.print(Text(found.heading(), style="bold"), soft_wrap=True)
    if found.costs:
        output.show_table(COLUMNS, found.rows())
    for remark in found.remarks:
        out.print(Text(remark), soft_wrap=True)
