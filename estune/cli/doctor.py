"""`estune doctor`: whether a rig is fit to be tuned, and what to mend."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.text import Text

from estune.cli import output
from estune.cli.checks import REPEATS, CheckResult, State, gentle_trial, run_checks
from estune.cli.values import security_from
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.security import OPEN
from estune.trial.profiles import StepProfile

_Flag = Parameter(negative=(), show_default=False)
_LOOKS = {State.FINE: "green", State.FIX: "bold red", State.UNKNOWN: "yellow"}


def doctor(
    endpoint: str,
    /,
    *,
    move: Annotated[bool, _Flag] = False,
    repeats: int = REPEATS,
    rig: str | None = None,
    json: Annotated[bool, _Flag] = False,
    security: Path | None = None,
) -> None:
    """Check a rig: what is fine and what to mend. Ends with an error if anything must be mended.

    Args:
        endpoint: Where the rig is, such as tcp/127.0.0.1:7447.
        move: Have the rig repeat a gentle step with its live gains, without being asked first.
        repeats: How often.
        rig: Name of the rig, where several answer at the endpoint.
        json: Print the findings as JSON.
        security: File that says who this is, where the rig asks; see docs/security.md.
    """
    if repeats < 2:
        raise InvalidInput(f"{repeats} repeats show no scatter; ask for 2 or more")
    who = security_from(security)
    with zenoh.connect(endpoint, rig=rig, security=who) as the_rig:
        about = the_rig.describe()
        move = move or (not json and _allowed(gentle_trial(about), about.gains, repeats))
        found = []
        for finding in run_checks(
            the_rig, endpoint, move=move, repeats=repeats, asked_who=who != OPEN
        ):
            found.append(finding)
            if not json:
                _show(finding)
    if json:
        output.print_json({"rig": about.name, "endpoint": endpoint, "findings": found})
    wrong = [finding.check for finding in found if finding.state is State.FIX]
    if wrong:
        raise RigError(f"rig {about.name}: to be mended, as said above: {', '.join(wrong)}")


def _allowed(step: StepProfile, gains: Gains, repeats: int) -> bool:
    """Whether somebody is there who says that the rig may be moved."""
    if not sys.stdin.isatty():
        return False
    answer = input(
        f"Move the rig? {repeats} steps from {step.preload_N:g} N by {step.step_N:+g} N, "
        f"{step.duration_s:g} s each, with its live gains {gains} [y/N] "
    )
    return answer.strip().lower() in ("y", "yes")


def _show(finding: CheckResult) -> None:
    line = Text.assemble(
        (f"{finding.state:<8}", _LOOKS[finding.state]), f"{finding.check:<12}", finding.sentence
    )
    if finding.remedy:
        line.append(f"\n{'':20}-> {finding.remedy}")
    output.console().print(line, soft_wrap=True)
