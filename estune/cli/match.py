"""`estune match`: several reels tuned to one and the same cost."""

import json as json_
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.text import Text

from estune.cli import output
from estune.cli.tune import CostOptions, StepOptions, TunerName
from estune.cli.values import security_from
from estune.errors import EstuneError, InvalidInput, RigError
from estune.run.export import replace_file
from estune.run.plan import DEFAULT_TUNER
from estune.run.targets import is_endpoint, open_target
from estune.run.toml_tables import CostTable, StepTable
from estune.studies.match import procedure
from estune.studies.match.outcome import Matching
from estune.studies.match.reel_matcher import Settings
from estune.support.toml_file import validate
from estune.trial import RigDescription

if TYPE_CHECKING:
    from estune.core.cost import StepCost
    from estune.remote.security import Security
    from estune.trial.profiles import StepProfile

_Flag = Parameter(negative=(), show_default=False)
_USUAL = Settings()
_NO_STEP, _NO_COST = StepOptions(), CostOptions()
_LABELLED = re.compile(r"(?:([A-Za-z0-9_-]+)=)?(.+)")


def match(
    targets: Annotated[list[str], Parameter(negative=())],
    /,
    *,
    eta: str = "auto",
    tolerance: float = _USUAL.tolerance,
    tuner: TunerName = DEFAULT_TUNER,
    trials: int = _USUAL.trials,
    match_trials: int = _USUAL.match_trials,
    repeats: int = _USUAL.repeats,
    apply: Annotated[bool, _Flag] = False,
    folder: Path | None = None,
    json: Annotated[bool, _Flag] = False,
    security: Path | None = None,
    quiet: Annotated[bool, _Flag] = False,
    step: StepOptions = _NO_STEP,
    cost: CostOptions = _NO_COST,
) -> None:
    """Tune several reels to one and the same cost. Ends with an error unless every reel passes.

    Args:
        targets: The reels, each an endpoint, a model file or module:attribute, with a label before
            it if you like: left=tcp/10.0.0.7:7447.
        eta: The cost aimed at; auto is what all can reach, the worst tuned reel's.
        tolerance: How far from it a reel may be, relative to it.
        tuner: How gains are proposed in each reel's own tuning.
        trials: Greatest number of search trials of each reel's own tuning.
        match_trials: Trials that look for the target on each reel.
        repeats: Repeats of the tuned and of the matched gains.
        apply: Make the matched gains of reels that pass live on their rigs.
        folder: Folder for the runs, match.json, match.csv and match.html; matches/TIME by default.
            A matching that was cut off goes on with the same command and this folder.
        json: Print the outcome as JSON.
        security: File that says who this is, where a rig asks; see docs/security.md.
        quiet: Show no progress.
        step: The step trial, the same for all reels; what is left out is what the first suggests.
        cost: How a trial is scored, the same for all reels; the settling time is by default the
            longest a rig suggests.
    """
    who, named = security_from(security), _named(targets)
    models = [label for label, target in named.items() if not is_endpoint(target)]
    if apply and models:
        raise InvalidInput(f"{', '.join(models)}: a model keeps no gains; leave out --apply")
    profile, score = _asked(named, who, step, cost)
    found = procedure.match(
        named,
        eta=_eta(eta),
        settings=Settings(tolerance, tuner, trials, match_trials, repeats),
        step=profile,
        cost=score,
        folder=folder,
        apply=apply,
        security=who,
        watch=None if quiet or json else "auto",
        tell=_tell if not (quiet or json) else lambda _: None,
    )
    written = _write(found)
    if json:
        output.print_json(found.to_json())
    else:
        _show(found)
        output.show_next(written)
    if not found.passed:
        wrong = [f"{reel.label} ({reel.standing})" for reel in found.reels if not reel.passed]
        raise RigError(f"not all reels pass: {', '.join(wrong)}; the reasons are in the table")


def _named(targets: list[str]) -> dict[str, str]:
    """The targets by label; those without one are numbered."""
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


def _asked(
    named: Mapping[str, str], who: "Security", step: StepOptions, cost: CostOptions
) -> "tuple[StepProfile | None, StepCost | None]":
    """What was asked for of the trial and its cost, filled in by what the rigs suggest."""
    if step == _NO_STEP and cost == _NO_COST:
        return None, None
    known: list[RigDescription] = []
    for target in named.values():
        try:
            with open_target(target, security=who) as rig:
                known.append(rig.describe())
        except EstuneError:
            continue  # the matching says which reel it was, and goes on
    if not known:
        return None, None
    common = procedure.common_suggestion(known)
    step_table = validate(StepTable, _given(step), "the step trial")
    cost_table = validate(CostTable, _given(cost), "its cost")
    return step_table.of(common), cost_table.of(common)


def _given(options: StepOptions | CostOptions) -> dict[str, Any]:
    return {name: value for name, value in vars(options).items() if value is not None}


def _tell(text: str) -> None:
    output.console().print(Text(text, style="dim"))


def _show(found: Matching) -> None:
    out = output.console()
    out.print()
    look = "bold green" if found.passed else "bold yellow"
    out.print(Text(found.heading(), style=look), soft_wrap=True)
    rows = [
        (
            *(reel.label, str(reel.tuned_level or "-"), str(reel.level or "-")),
            *(_gains(reel.gains.as_tuple()) if reel.gains else "-",),
            *(str(reel.standing), "live" if reel.live else ""),
        )
        for reel in found.reels
    ]
    output.show_table(("reel", "tuned cost", "matched cost", "P, I, D, filter", "", ""), rows)
    for reel in found.reels:
        if not reel.passed:
            out.print(Text(f"{reel.label}: {reel.reason}"), soft_wrap=True)


def _gains(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _write(found: Matching) -> dict[str, object]:
    """Writes the record for production beside the runs; what was written, by name."""
    from estune.studies.match.page import page  # noqa: PLC0415  draws, which is slow to import

    if found.folder is None:
        return {}
    found.folder.mkdir(parents=True, exist_ok=True)
    table = found.to_frame().to_csv(index=False)
    contents = {
        "match.json": json_.dumps(output.plain(found.to_json()), indent=2, allow_nan=False),
        "match.csv": table,
        "match.html": page(found),
    }
    for name, text in contents.items():
        replace_file(found.folder / name, text.encode())
    return {"record": found.folder / "match.csv", "page": found.folder / "match.html"}
