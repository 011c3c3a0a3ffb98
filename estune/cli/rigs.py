"""`estune rigs` and `estune apply`: rigs, and the gains that are live on them."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from estune import api
from estune.cli import output
from estune.cli.runs import find_run
from estune.cli.values import security_from
from estune.core.gains import GAIN_NAMES, GAIN_UNITS, Gains
from estune.errors import RigError
from estune.remote import messages, zenoh
from estune.remote.security import Security
from estune.run.targets import open_target
from estune.trial import RigDescription


def rigs(endpoint: str, /, *, security: Path | None = None) -> None:
    """Say which rigs answer at an endpoint, and how they stand.

    Args:
        endpoint: Where to look, such as tcp/127.0.0.1:7447.
        security: File that says who this is, where the rigs ask; see docs/security.md.
    """
    who = security_from(security)
    found = zenoh.discover_rigs(endpoint, security=who)
    if not found:
        raise RigError(
            f"no rig answers at {endpoint}; start one with: estune serve --listen {endpoint}"
        )
    rows = [_row(endpoint, presence, who) for presence in found]
    output.show_table(("rig", "state", "cable length", "step", "live gains", "software"), rows)


def apply(
    run: str,
    target: str,
    /,
    *,
    start: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
    rig: str | None = None,
    security: Path | None = None,
    folder: Path = Path(api.RUNS),
) -> None:
    """Make a run's gains, or its start gains, live on a rig.

    Args:
        run: The run: its name, or its folder.
        target: Where the rig is, such as tcp/127.0.0.1:7447.
        start: Put the gains back that the run began from.
        rig: Name of the rig; the one the run was made on by default.
        security: File that says who this is, where the rig asks; see docs/security.md.
        folder: Folder that runs are kept in.
    """
    result = api.load(find_run(run, folder))
    wanted = result.start_gains if start else result.gains
    with open_target(target, rig, security_from(security)) as the_rig:
        before = the_rig.describe()
        if rig is None and before.name != result.rig.name:
            raise RigError(
                f"the run was made on rig {result.rig.name}, at {target} is {before.name}; "
                f"to use its gains there all the same, say --rig {before.name}"
            )
        the_rig.apply(wanted)
        after = the_rig.describe()
    _show_change(before, after)
    if after.gains != wanted:
        raise RigError(f"{after.name} runs {after.gains}, not the gains it was given: {wanted}")
    print(f"{after.name} confirms that these gains are live")
    if not start and not result.success:
        print(f"they are the gains the run began from: {result.message}")
    elif not start:
        print(f"put the old ones back with: estune apply {result.folder} {target} --start")


def estop(
    endpoint: str,
    /,
    *,
    rig: str | None = None,
    reason: str = "estune estop",
    security: Path | None = None,
) -> None:
    """Bring a rig to its safe state at once, whoever commands it; it stays there until cleared.

    Args:
        endpoint: Where the rig is, such as tcp/127.0.0.1:7447.
        rig: Name of the rig, where several answer at the endpoint.
        reason: Why; whoever commands the rig is told.
        security: File that says who this is, where the rig asks; see docs/security.md.
    """
    with zenoh.connect(endpoint, rig=rig, security=security_from(security)) as the_rig:
        the_rig.estop(reason)
        print(f"{the_rig.name} is stopped and held; when you have seen to it: estune clear")


def clear(endpoint: str, /, *, rig: str | None = None, security: Path | None = None) -> None:
    """End a rig's emergency stop. For whoever has seen to the rig.

    Args:
        endpoint: Where the rig is, such as tcp/127.0.0.1:7447.
        rig: Name of the rig, where several answer at the endpoint.
        security: File that says who this is, where the rig asks; see docs/security.md.
    """
    with zenoh.connect(endpoint, rig=rig, security=security_from(security)) as the_rig:
        the_rig.clear()
        print(f"{the_rig.name} is cleared: {the_rig.status().mode.sentence}")


def _show_change(before: RigDescription, after: RigDescription) -> None:
    def cell(gains: Gains, name: str) -> str:
        return f"{getattr(gains, name):.6g} {GAIN_UNITS[name]}"

    rows = [(name, cell(before.gains, name), cell(after.gains, name)) for name in GAIN_NAMES]
    output.show_table(("", "old", "new"), rows)


def _row(endpoint: str, presence: messages.Presence, security: Security) -> tuple[str, ...]:
    try:
        with zenoh.connect(endpoint, rig=presence.rig, security=security) as rig:
            about, status = rig.describe(), rig.status()
    except RigError as error:
        return (presence.rig, "-", "-", "-", str(error), "-")
    length = "-" if about.cable_length_m is None else f"{about.cable_length_m:g} m"
    step = f"{about.step.preload_N:g} N {about.step.step_N:+g} N, {about.step.duration_s:g} s"
    return (about.name, _doing(status), length, step, str(about.gains), about.software)


def _doing(status: messages.Status) -> str:
    """What a rig does, and at whose command."""
    parts = [status.mode.value]
    if status.trial_id:
        parts.append(f"trial {status.trial_id}")
    if status.holder:
        parts.append(f"held by {status.holder}")
    if status.latched:
        parts.append(f"emergency stop: {status.latched}")
    return ", ".join(parts)
