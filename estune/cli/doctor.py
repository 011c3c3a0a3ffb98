"""`estune doctor`: checks of a rig, each with its remedy."""

import sys
from contextlib import ExitStack

from rich.text import Text

from estune.cli import output
from estune.cli.checks import (
    REPEATS,
    CheckResult,
    State,
    gentle_trial,
    run_checks,
    run_file_checks,
)
from estune.cli.values import Flag, RigName, SecurityFile, security_from
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.security import OPEN
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile

_STYLES = {State.FINE: "green", State.FIX: "bold red", State.UNKNOWN: "yellow"}


def doctor(
    endpoint: str,
    /,
    *,
    move: Flag = False,
    repeats: int = REPEATS,
    rig: RigName = None,
    json: Flag = False,
    security: SecurityFile = None,
) -> None:
    """Check a rig. Lists failed checks with remedies, and exits with code 4 until all pass.

    A rig's file, where nothing serves it yet, has its driver checked: messages, time budget of
    bus, adapter and host, and whether the loop must move to the board.

    Args:
        endpoint: Address of the rig, such as tcp/127.0.0.1:7447, or its file, such as my-rig.toml.
        move: Have the rig repeat a gentle step with its live gains, and once in an open loop,
            without a prompt.
        repeats: Number of repeats.
        json: Print the results as JSON.
    """
    if repeats < 2:
        raise InvalidInput(f"{repeats} repeats show no repeatability; ask for 2 or more")

    def may_move(about: RigDescription) -> bool:
        return move or (not json and _allowed(gentle_trial(about), about, repeats))

    with ExitStack() as opened:
        if endpoint.endswith(".toml"):
            from estune.hardware import read_config  # noqa: PLC0415  slow to import

            config = read_config(endpoint)
            about = config.describe()
            checks = run_file_checks(config, move=may_move(about), repeats=repeats)
        else:
            credentials = security_from(security)
            the_rig = opened.enter_context(zenoh.connect(endpoint, rig=rig, security=credentials))
            about = the_rig.describe()
            checks = run_checks(
                *(the_rig, endpoint),
                move=may_move(about),
                repeats=repeats,
                authenticated=credentials != OPEN,
            )
        results = []
        for result in checks:
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


def _allowed(step: StepProfile, rig: RigDescription, repeats: int) -> bool:
    """Whether the operator allows the rig to move."""
    if not sys.stdin.isatty():
        return False
    answer = input(
        f"Move the rig? {repeats} steps from {rig.step_text(step)}, {step.duration_s:g} s each, "
        f"with its live gains {rig.gains_text(rig.gains)}, and one of the command in an open "
        "loop [y/N] "
    )
    return answer.strip().lower() in ("y", "yes")


def _show(result: CheckResult) -> None:
    line = Text.assemble(
        (f"{result.state:<8}", _STYLES[result.state]), f"{result.check:<13}", result.sentence
    )
    if result.remedy:
        line.append(f"\n{'':21}-> {result.remedy}")
    output.console().print(line, soft_wrap=True)
