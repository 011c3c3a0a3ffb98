"""Commands on served rigs: `estune discover`, `estop` and `clear`.

An emergency stop waits for what this module imports.
"""

from pathlib import Path
from typing import Any

from estune.cli import output
from estune.cli.values import Json, RigName, SecurityFile, command_line, security_from
from estune.errors import RigError
from estune.remote import messages, zenoh
from estune.remote.security import Security
from estune.trial import RigDescription

STOP_PRIORITY = 20
"""Real-time priority of an emergency stop, where the system grants it."""


def discover(endpoint: str, /, *, security: Path | None = None, json: Json = False) -> None:
    """List the rigs at an endpoint and their status.

    Args:
        endpoint: Where to look, such as tcp/127.0.0.1:7447.
        security: Credentials file, if the rigs require authentication.
    """
    credentials = security_from(security)
    presences = zenoh.discover_rigs(endpoint, security=credentials)
    if not presences:
        messages.choose((), None, endpoint)  # raises the reason
    found = {p.rig: _described(endpoint, p.rig, credentials) for p in presences}
    if json:
        output.print_json({name: _facts(known) for name, known in found.items()})
        return
    rows = [_row(name, known) for name, known in found.items()]
    output.show_table(("rig", "state", "cable length", "step", "live gains", "software"), rows)


def estop(
    endpoint: str,
    /,
    *,
    rig: RigName = None,
    reason: str = "estune estop",
    security: SecurityFile = None,
) -> None:
    """Stop a rig at once, whichever client controls it; it stays in its safe state until reset.

    Args:
        endpoint: Address of the rig, such as tcp/127.0.0.1:7447.
        reason: Reason, reported to the client that controls the rig.
    """
    from estune.hardware.real_time import prioritised  # noqa: PLC0415  of no use elsewhere

    with (
        prioritised(STOP_PRIORITY),  # on a busy machine the stop itself would wait for its turn
        zenoh.connect(endpoint, rig=rig, security=security_from(security)) as the_rig,
    ):
        the_rig.estop(reason)
        reset = command_line("clear", endpoint, rig=rig, security=security)
        print(f"{the_rig.name} is stopped and held; once it is safe, reset it with: {reset}")


def clear(endpoint: str, /, *, rig: RigName = None, security: SecurityFile = None) -> None:
    """Reset the emergency stop of a rig, once you have checked that it is safe.

    Args:
        endpoint: Address of the rig, such as tcp/127.0.0.1:7447.
    """
    with zenoh.connect(endpoint, rig=rig, security=security_from(security)) as the_rig:
        the_rig.clear()
        print(f"{the_rig.name} is cleared: {the_rig.status().mode.sentence}")


Described = tuple[RigDescription, messages.Status] | RigError
"""Description and status of a rig, or why there are none."""


def _described(endpoint: str, rig: str, security: Security) -> Described:
    try:
        with zenoh.connect(endpoint, rig=rig, security=security) as there:
            return there.describe(), there.status()
    except RigError as error:
        return error


def _facts(known: Described) -> dict[str, Any]:
    """The JSON form of a rig's description."""
    if isinstance(known, RigError):
        return {"fault": str(known)}
    about, status = known
    return {
        "status": output.plain(status),
        "gains": output.plain(about.gains),
        "cable_length_m": about.cable_length_m,
        "step": output.plain(about.step),
        "software": about.software,
    }


def _row(name: str, known: Described) -> tuple[str, ...]:
    if isinstance(known, RigError):
        return (name, str(known), "-", "-", "-", "-")
    about, status = known
    length = "-" if about.cable_length_m is None else f"{about.cable_length_m:g} m"
    step = f"{about.step_text(about.step)}, {about.step.duration_s:g} s"
    gains = about.gains_text(about.gains)
    return (name, _state(status), length, step, gains, about.software)


def _state(status: messages.Status) -> str:
    """Mode of a rig, its trial and its lease holder."""
    parts = [status.mode.value]
    if status.trial_id:
        parts.append(f"trial {status.trial_id}")
    if status.holder:
        parts.append(f"held by {status.holder}")
    if status.latched:
        parts.append(f"emergency stop: {status.latched}")
    return ", ".join(parts)
