"""`estune doctor`: checks of a rig, each with its remedy."""

import sys
from pathlib import Path

from rich.text import Text

from estune.cli import output
from estune.cli.checks import REPEATS, CheckResult, State, gentle_trial, run_checks
from estune.cli.values import Flag, security_from
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.security import OPEN
from estune.trial.profiles import StepProfile

_STYLES = {State.FINE: "green", State.FIX: "bold red", State.UNKNOWN: "yellow"}


def doctor(
    endpoint: str,
    /,
    *,
    move: Flag = False,
    repeats: int = REPEATS,
    rig: str | None = None,
    json: Flag = False,
    security: Path | None = None,
) -> None:
    """Check a rig. Lists failed checks with remedies, and exits with code 4 until all pass.

    Args:
        endpoint: Address of the rig, such as tcp/127.0.0.1:7447.
        move: Have the rig repeat a gentle step with its live gains, without a prompt.
        repeats: Number of repeats.
        rig: Name of the rig, if several answer at the endpoint.
        json: Print the results as JSON.
        security: Credentials file, if the rig requires authentication.
    """
    if repeats < 2:
        raise InvalidInput(f"{repeats} repeats show no repeatability; ask for 2 or more")
    credentials = security_from(security)
    with zenoh.connect(endpoint, rig=rig, security=credentials) as the_rig:
        about = the_rig.describe()
        move = move or (not json and _allowed(gentle_trial(about), about.gains, repeats))
        results = []
        for result in run_checks(
            the_rig, endpoint, move=move, repeats=repeats, authenticated=credentials != OPEN
        ):
            results.append(result)
            if not json:
                _show(result)
    if json:
        output.print_json({"rig": about.name, "endpoint": endpoint, "findings": results})
    failed = [result.check for result in results if result.state is State.FIX]
    if failed:
        raise RigError(
            f"rig {about.name}: failed checks: {', '.join(failed)}; follow the remedies above"
        )


def _allowed(step: StepProfile, gains: Gains, repeats: int) -> bool:
    """Whether the operator allows the rig to move."""
    if not sys.stdin.isatty():
        return False
    answer = input(
        f"Move the rig? {repeats} steps from {step.preload_N:g} N by {step.step_N:+g} N, "
        f"{step.duration_s:g} s each, with its live gains {gains} [y/N] "
    )
    return answer.strip().lower() in ("y", "yes")


def _show(result: CheckResult) -> None:
    line = Text.assemble(
        (f"{result.state:<8}", _STYLES[result.state]), f"{result.check:<12}", result.sentence
    )
    if result.remedy:
        line.append(f"\n{'':20}-> {result.remedy}")
    output.console().print(line, soft_wrap=True)
