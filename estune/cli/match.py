"""`estune match`: several reels tuned to the same cost."""

import json as json_
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.text import Text

from estune.cli import output
from estune.cli.interruption import continued_by_same_command
from estune.cli.options import NO_COST, NO_STEP, CostOptions, StepOptions, TunerName
from estune.cli.tune import trial_of
from estune.cli.values import Flag, Quiet, check_folder_exists, security_from
from estune.errors import EstuneError, InvalidInput, RigError
from estune.run.targets import is_endpoint, open_target
from estune.studies.match import procedure
from estune.studies.match.outcome import Matching
from estune.studies.match.reel_matcher import Settings
from estune.support.whole_file import write_file
from estune.trial import RigDescription
from estune.tuners import DEFAULT_TUNER

if TYPE_CHECKING:
    from estune.remote.security import Security

_DEFAULTS = Settings()
_LABELLED = re.compile(r"(?:([A-Za-z0-9_-]+)=)?(.+)")


def match(
    targets: Annotated[list[str], Parameter(negative=())],
    /,
    *,
    eta: str = "auto",
    tolerance: float = _DEFAULTS.tolerance,
    tuner: TunerName = DEFAULT_TUNER,
    trials: int = _DEFAULTS.trials,
    match_trials: int = _DEFAULTS.match_trials,
    repeats: int = _DEFAULTS.repeats,
    apply: Flag = False,
    folder: Path | None = None,
    report: Path | None = None,
    json: Flag = False,
    security: Path | None = None,
    patience: float | None = None,
    quiet: Quiet = False,
    step: StepOptions = NO_STEP,
    cost: CostOptions = NO_COST,
) -> None:
    """Tune several reels to the same cost. Ends with an error unless every reel passes.

    Args:
        targets: The reels, each an endpoint, a model file or module:attribute, with an optional
            label before it: left=tcp/10.0.0.7:7447.
        eta: Target cost; auto is the lowest that all reels reach, that of the worst tuned reel.
        tolerance: Greatest relative deviation from the target cost.
        tuner: Tuner of each reel's own tuning.
        trials: Maximum number of search trials of each reel's own tuning.
        match_trials: Trials that search for the target cost on each reel.
        repeats: Repeats of the tuned and of the matched gains.
        apply: Make the matched gains of reels that pass live on their rigs.
        folder: Folder for the runs, match.json, match.csv and match.html; matches/TIME by default.
            An interrupted matching continues with the same command and this folder.
        report: File of the report page; match.html in the folder by default.
        json: Print the outcome as JSON.
        security: Credentials file, if a rig requires authentication.
        patience: How long to wait for a rig to appear, and where it stops
            replying, s; 3 s and 30 s by default.
        step: The step trial of all reels; by default what the first reel suggests.
        cost: The cost of all reels; the settling time is by default the longest a rig suggests.
    """
    check_folder_exists("--report", report)
    credentials, named = security_from(security), _named(targets)
    models = [label for label, target in named.items() if not is_endpoint(target)]
    if apply and models:
        raise InvalidInput(f"{', '.join(models)}: a model keeps no gains; leave out --apply")
    where = folder or procedure.free_folder()
    with continued_by_same_command(where, folder):
        matching = procedure.match(
            named,
            eta=_eta(eta),
            settings=Settings(tolerance, tuner, trials, match_trials, repeats),
            **_common_trial(named, credentials, step, cost),
            folder=where,
            apply=apply,
            security=credentials,
            patience_s=patience,
            watch=None if quiet or json else "auto",
            log=_print_note if not (quiet or json) else lambda _: None,
        )
    files = _write(matching, report)
    if json:
        output.print_json(matching.to_json())
    else:
        _show(matching)
        output.show_next(files)
    if not matching.passed:
        failed = [f"{reel.label} ({reel.outcome})" for reel in matching.reels if not reel.passed]
        raise RigError(f"not all reels pass: {', '.join(failed)}; the reasons are in the table")


def _named(targets: list[str]) -> dict[str, str]:
    """The targets by label; targets without a label are numbered."""
    named: dict[str, str] = {}
    for n, text in enumerate(targets, 1):
        label, target = _LABELLED.fullmatch(text).groups() if text else (None, "")  # type: ignore[union-attr]  # matches all but ""
        name = label or f"reel{n}"
        if name in named:
            raise InvalidInput(f"label {name} is given twice; give each reel its own")
        named[name] = target
    return named


def _eta(text: str) -> "float | procedure.Auto":
    if text == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"--eta {text} is neither a number nor auto") from None


def _common_trial(
    named: Mapping[str, str], credentials: "Security", step: StepOptions, cost: CostOptions
) -> dict[str, Any]:
    """Step and cost of all reels, where options are given; the rigs' suggestions complete them."""
    if step == NO_STEP and cost == NO_COST:
        return {}
    descriptions: list[RigDescription] = []
    for target in named.values():
        try:
            with open_target(target, security=credentials) as rig:
                descriptions.append(rig.describe())
        except EstuneError:
            continue  # the matching itself reports the reel, and continues
    if not descriptions:
        return {}
    return trial_of(procedure.common_description(descriptions), step, cost)


def _print_note(text: str) -> None:
    output.console().print(Text(text, style="dim"))


def _show(matching: Matching) -> None:
    print()
    output.show_outcome(matching.heading(), good=matching.passed)
    output.show_study(matching.table())


def _write(matching: Matching, report: Path | None) -> dict[str, object]:
    """Writes the record for production beside the runs; the main files, by name."""
    from estune.studies.match.report import page  # noqa: PLC0415  draws: slow to import
    from estune.support.html_page import write  # noqa: PLC0415  as above

    if matching.folder is None:
        return {}
    matching.folder.mkdir(parents=True, exist_ok=True)
    table = matching.to_frame().to_csv(index=False)
    where = {name: matching.folder / f"match.{name}" for name in ("json", "csv", "html")}
    contents = {
        "json": json_.dumps(output.plain(matching.to_json()), indent=2, allow_nan=False),
        "csv": table,
    }
    for name, text in contents.items():
        write_file(where[name], text.encode())
    report = report or where["html"]
    write(page(matching), report)
    return {"record": where["csv"], "page": report}
