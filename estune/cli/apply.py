"""`estune apply`: the gains of a run made live on a rig."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import estune
from estune.cli import output
from estune.cli.runs import find_run
from estune.cli.values import (
    Flag,
    RunName,
    RunsFolder,
    SecurityFile,
    command_line,
    security_from,
    share_from,
)
from estune.core.gain_forms import backed_off
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput, RigError
from estune.proof.patch import SUFFIX as PATCH_SUFFIX
from estune.run.journal import RUNS
from estune.run.limit_verdict import LimitState
from estune.run.robustness import claim_from
from estune.run.targets import is_endpoint, open_target
from estune.support.quantity_text import with_unit
from estune.trial import RigDescription

if TYPE_CHECKING:
    from estune.run.results.result import TuneResult


def apply(
    run: RunName,
    target: str,
    /,
    *,
    start: Flag = False,
    yes: Flag = False,
    backoff: str = "0%",
    rig: str | None = None,
    security: SecurityFile = None,
    folder: RunsFolder = Path(RUNS),
) -> None:
    """Make the gains of a run, or its start gains, live on a rig; or put a patch in a rig's file.

    Args:
        run: The run: its name, or its folder; or a patch of estune remedy, NAME.remedy.json. Run
            and rig are taken in either order.
        target: Address of the rig, such as tcp/127.0.0.1:7447; for a patch the rig's file.
        start: Restore the gains that were live when the run began.
        yes: Apply gains that break a limit of the run without a prompt.
        backoff: Share by which P, I and D are lowered, such as 25%, for margin beside the optimum.
        rig: Name of the rig; the rig of the run by default.
    """
    if target.endswith(PATCH_SUFFIX) or is_endpoint(run):
        run, target = target, run
    if run.endswith(PATCH_SUFFIX):
        from estune.cli.remedy import apply_patch  # noqa: PLC0415  slow to import

        apply_patch(Path(run), Path(target), yes=yes)
        return
    result = estune.load(find_run(run, folder))
    share = share_from("--backoff", backoff)
    _check_gains(result, start=start, share=share)
    if not (start or yes):
        _confirm_limits(result)
    gains = result.rig.gains if start else backed_off(result.gains, share)
    with open_target(target, rig, security_from(security)) as the_rig:
        before = the_rig.describe()
        if rig is None and before.name != result.rig.name:
            raise RigError(
                f"the run was made on rig {result.rig.name}, at {target} is {before.name}; "
                f"to use its gains there all the same, give --rig {before.name}"
            )
        the_rig.apply(gains)
        after = the_rig.describe()
    rows = [(name, _gain(before, name), _gain(after, name)) for name in GAIN_NAMES]
    output.show_table(("", "old", "new"), rows)
    if after.gains != gains:
        raise RigError(
            f"{after.name} runs {after.gains}, not the requested gains: {gains}; check the rig"
        )
    print(f"{after.name} confirms that these gains are live")
    if not start and result.limits is not None and result.limits.reason:
        print(f"{result.ending}: {result.limits.reason}")
    if share:
        print(_backed_off_sentence(result, gains, share))
    if not start and not result.success:
        print(f"they are the gains the run began from: {result.message}")
    if not start and before.gains != gains:
        restores = before.gains == result.rig.gains
        back = command_line("apply", result.folder, target, rig=rig, security=security)
        print(f"restore the old ones with: {back} --start" if restores else _not_kept(before))


def _not_kept(before: RigDescription) -> str:
    """What is said of gains that no run can restore: `--start` has those of another time."""
    old = ", ".join(f"{name} {_gain(before, name)}" for name in GAIN_NAMES)
    return f"the old ones are not those that the run began from; keep them: {old}"


def _check_gains(result: "TuneResult", *, start: bool, share: float) -> None:
    """Refuses gains that a run does not have.

    Raises:
        InvalidInput: the initial gains were asked for with a margin.
        RigError: the run has no tuned gains yet.
    """
    if start and share:
        raise InvalidInput("--start restores gains as they were; leave --backoff out")
    if not start and not result.verdict.complete:
        raise RigError(
            f"{result.verdict.message}: the run has no tuned gains yet; finish it with: estune "
            f"resume {result.folder}, or restore the gains it began from with --start"
        )


def _confirm_limits(result: "TuneResult") -> None:
    """Asks before gains go live that break a limit of their run.

    Raises:
        InvalidInput: they do, and the answer is no or nobody can be asked.
    """
    if result.limits is None or result.limits.state is not LimitState.BROKEN:
        return
    if sys.stdin.isatty():
        answer = input(f"{result.limits.reason}; apply these gains all the same? yes or no: ")
        if answer.strip().lower() in ("y", "yes"):
            return
    raise InvalidInput(
        f"{result.limits.reason}: nothing was applied; tune with --tuner model_based, which keeps "
        "the limits, or apply them all the same with --yes"
    )


def _backed_off_sentence(result: "TuneResult", gains: Gains, share: float) -> str:
    """Costs and benefits of the margin, as far as the records of the run show them."""
    said = (
        f"backed off by {share:.0%}: any gain margin is {1.0 / (1.0 - share):.3g} times as large"
    )
    claims = (
        claim_from(result.identified, result.plan, result.rig, g) for g in (result.gains, gains)
    )
    before, after = (claim.margins for claim in claims)
    if before is None or after is None:
        return said
    return (
        f"{said}; Ms {before.sensitivity.value:.2f} becomes {after.sensitivity.value:.2f}, the "
        f"overshoot {before.overshoot.value:.1%} {after.overshoot.value:.1%}"
    )


def _gain(rig: RigDescription, name: str) -> str:
    return with_unit(getattr(rig.gains, name), rig.gain_units[name], 6)
