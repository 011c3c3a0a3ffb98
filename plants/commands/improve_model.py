"""`estune improve-model`: a rig's model improved by experiment, and the rig tuned with it."""

import math
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from estune.cli import output
from estune.cli.values import (
    Effects,
    Json,
    Quiet,
    RigName,
    SecurityFile,
    Values,
    check_folder_exists,
    command_line,
    security_from,
)
from estune.errors import RigError
from estune.run.loop import Stopped
from estune.run.plan import REPEATS, TRIALS
from estune.run.progress import showing_phases
from estune.run.targets import is_endpoint, open_target
from plants.commands.columns import Sources, column_map
from plants.commands.explain import can_be_tuned

if TYPE_CHECKING:
    from plants.improvement.result import Improvement


def improve_model(
    target: str,
    /,
    *,
    model: str | None = None,
    folder: Path | None = None,
    data: Path | None = None,
    map_: Sources = (),
    unit: Values = (),
    scale: Values = (),
    rounds: int = 6,
    model_trials: int = TRIALS,
    trials: int = 40,
    repeats: int = REPEATS,
    effects: Effects = (),
    json: Json = False,
    report: Path | None = None,
    save: Path | None = None,
    rig: RigName = None,
    security: SecurityFile = None,
    quiet: Quiet = False,
) -> None:
    """Improve a rig's model by experiment, then tune the rig with it.

    Args:
        target: The rig: an endpoint such as tcp/127.0.0.1:7447, a model file such as reel.toml,
            or module:attribute such as plants:reference_reel.
        model: The initial model: a model file or module:attribute; by default the reference reel
            at the rig's cable length, or the linear model in the rig's description.
        folder: Folder for records, trial files and the tuning's run; the time of day by default.
            The folder of an improvement that was interrupted continues it.
        data: Records of the rig that are there already, as of estune explain; explained together
            with the experiments.
        map_: Where their columns come from: time=t,current=vir,angle=qm, or a TOML file of them.
        unit: Their units, such as angle=mm,tension=lbf.
        scale: Factors to the unit, such as current=35.15.
        rounds: Maximum number of rounds of experiments and diagnosis.
        model_trials: Maximum number of search trials on the improved model.
        trials: Maximum number of search trials on the rig.
        repeats: Trials of each set of gains whose cost is compared.
        effects: Effects of your own that join the search, each as module:Class.
        report: Write costs, the last diagnosis and the tuning as one HTML page.
        save: Write the improved model as a model file.
    """
    check_folder_exists("--report", report)
    check_folder_exists("--save", save)
    import plants  # noqa: PLC0415  slow to import
    from plants.effects import declared, find  # noqa: PLC0415  slow to import
    from plants.improvement.experiment_runner import (  # noqa: PLC0415  slow to import
        default_folder,
    )
    from plants.improvement.tuning import ImprovementOptions  # noqa: PLC0415  slow to import

    where = folder or default_folder()
    options = {"--model": model, "--rig": rig, "--security": security, "--folder": where}
    options["--data"] = data
    words = ["estune", "improve-model", target]
    words += [str(w) for pair in options.items() if pair[1] is not None for w in pair]
    listed = {"--effects": effects, "--map": map_, "--unit": unit, "--scale": scale}
    words += [w for name, values in listed.items() for value in values for w in (name, value)]
    own = tuple(map(find, effects))
    columns = column_map(map_, unit, scale, None)
    silent = quiet or json
    initial = None if model is None else plants.load_model(model)
    with (
        _continuable(shlex.join(words)),
        open_target(target, rig, security_from(security)) as the_rig,
        showing_phases(quiet=silent) as progress,
    ):
        improvement = plants.improve(
            the_rig,
            initial,
            folder=where,
            data=data,
            columns=columns,
            effects=(*declared(), *own) if own else None,
            rounds=rounds,
            tuning=ImprovementOptions(
                model_trials=model_trials,
                rig_trials=trials,
                repeats=repeats,
                watch=None if silent else "auto",
            ),
            say=(lambda _: None) if silent else output.console().print,
            progress=progress,
        )
    if report is not None:
        from estune.support.html_page import write  # noqa: PLC0415  draws: slow to import
        from plants.improvement.page import page  # noqa: PLC0415  as above

        write(page(improvement), report)
    if save is not None:
        plants.save_model(improvement.model, save)
    if json:
        output.print_json(improvement.to_json())
        return
    _show(improvement)
    facts: dict[str, object] = {"records": improvement.folder / "data"}
    tuning = improvement.tuning
    # A cost that is not known is no reason to trust gains.
    measured = all(math.isfinite(row.measured) for row in improvement.costs)
    if measured and tuning is not None and tuning.ending.is_offered and is_endpoint(target):
        facts["make live"] = command_line("apply", tuning.folder, target)
    if save is not None:
        facts["model"] = save
        if can_be_tuned(improvement.model):
            facts["try it"] = command_line("tune", save)
    output.show_next(facts)
    if improvement.conclusion:
        output.show_line(improvement.conclusion, "bold")


@contextmanager
def _continuable(command: str) -> Iterator[None]:
    """Says by which command an improvement that ends early is continued."""
    try:
        yield
    except Stopped as stop:
        stop.again = command
        raise
    except RigError as error:
        error.args = (f"{error}; continue with: {command}",)
        raise


def _show(improvement: "Improvement") -> None:
    from plants.improvement.result import COLUMNS  # noqa: PLC0415  slow to import

    print()
    output.show_line(improvement.heading(), "bold")
    if improvement.costs:
        output.show_table(COLUMNS, improvement.rows())
    for remark in improvement.remarks:
        output.show_line(remark)
