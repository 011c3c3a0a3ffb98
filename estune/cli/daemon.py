"""`estune daemon` and `estune control`: rigs that are tuned and watched for days."""

import getpass
import os
import signal
import socket
from pathlib import Path
from types import FrameType
from typing import Annotated, Literal, get_args

from cyclopts import Parameter

from estune.cli import output
from estune.cli.values import security_from
from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput
from estune.remote.messages.daemon import DaemonStatus, DaemonVerb

_Flag = Parameter(negative=(), show_default=False)

Asked = Literal["status", "history", "events"]


def daemon(
    config: Path,
    /,
    *,
    check: Annotated[bool, _Flag] = False,
    security: Path | None = None,
    log: Literal["auto", "json", "text"] = "auto",
    verbose: Annotated[bool, _Flag] = False,
) -> None:
    """Tune rigs, keep what was accepted, and tune again when it no longer holds; until stopped.

    Args:
        config: The daemon's file; see docs/daemon.md.
        check: Only say whether the file is right.
        security: File that says who this is, where a rig asks; see docs/security.md.
        log: JSON lines or text, on standard error; text on a terminal if left to itself.
        verbose: Log every check trial, too.
    """
    from estune.daemon.config import read_config  # noqa: PLC0415  slow to import
    from estune.daemon.logs import begin_logging  # noqa: PLC0415  as above
    from estune.daemon.service import DaemonService  # noqa: PLC0415  as above

    settings, who = read_config(config), security_from(security)
    if check:
        print(f"{config}: {len(settings.rig)} rigs, nothing wrong")
        return
    begin_logging(log, verbose=verbose)
    service = DaemonService(settings, security=who)

    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  a signal handler
        service.stop()

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    print(f"daemon at {service.endpoint}", flush=True)
    service.run()


def control(
    verb: DaemonVerb | Asked,
    endpoint: str,
    /,
    *,
    rig: str | None = None,
    why: str = "",
    limit: int = 20,
    security: Path | None = None,
    json: Annotated[bool, _Flag] = False,
) -> None:
    """Ask a daemon how a rig stands, or tell it what to do.

    Args:
        verb: status, history, events; accept, reject, revert, pause, resume, stop.
        endpoint: Where the daemon listens, such as tcp/127.0.0.1:7450.
        rig: Which rig; may be left out where there is one.
        why: Why, for the daemon's history.
        limit: Most rows of history or events.
        security: File that says who this is, where the daemon asks; see docs/security.md.
        json: Print JSON.
    """
    from estune.remote.zenoh.daemon_service import DaemonClient  # noqa: PLC0415  slow to import

    with DaemonClient(endpoint, security=security_from(security)) as client:
        names = client.rigs() if rig is None else (rig,)
        if not names:
            client.status("any")  # says that no daemon answers
        if verb in get_args(DaemonVerb):
            if len(names) > 1:
                raise InvalidInput(f"name the rig with --rig: {', '.join(names)}")
            said = client.command(names[0], verb, _whoami(), why)  # type: ignore[arg-type]
            status = client.status(names[0])
            if json:
                output.print_json(status)
                return
            print(said)
            _show_status(status)
        elif verb == "status":
            statuses = [client.status(name) for name in names]
            if json:
                output.print_json(statuses)
                return
            for status in statuses:
                _show_status(status)
        elif verb == "events":
            found = [event for name in names for event in client.events(name, limit=limit)]
            if json:
                output.print_json(found)
                return
            rows = [(e.at, e.rig, e.kind, e.sentence) for e in found]
            output.show_table(("at", "rig", "event", ""), rows)
        else:
            _show_history(client, names, limit, as_json=json)


def _show_status(status: DaemonStatus) -> None:
    live = f"{status.live} gains" if status.live else "not confirmed by the rig now"
    facts: dict[str, object] = {
        "rig": status.rig,
        "mode": f"{status.mode}: {status.sentence}",
        "live": f"{live}; home: {status.home}, for: {status.why}",
    }
    facts |= status.gains
    if status.found:
        facts["candidate is"] = status.found
    if status.run:
        of = f" of {status.trials_max}" if status.trials_max else ""
        facts["run"] = f"{status.run}, {status.trials}{of} trials"
    if status.baseline_cost is not None:
        drift = 0.0 if status.drift is None else status.drift
        last = "" if status.cost is None else f", last {status.cost:.4g}"
        facts["cost"] = f"{status.baseline_cost:.4g}{last}; drift {drift:+.0%} of the limit"
    if status.next_check_s is not None:
        facts["next check"] = f"in {status.next_check_s:.0f} s, {status.checks} so far"
    if status.paused:
        facts["paused"] = status.paused
    if status.trouble:
        facts["trouble"] = status.trouble
    output.show_next(facts)


def _show_history(client: object, names: tuple[str, ...], limit: int, *, as_json: bool) -> None:
    from estune.remote.zenoh.daemon_service import DaemonClient  # noqa: PLC0415  slow to import

    assert isinstance(client, DaemonClient)  # noqa: S101  for the type checker
    found = {name: client.history(name, limit) for name in names}
    if as_json:
        output.print_json(found)
        return
    for name, history in found.items():
        print(name)
        sets = [
            (row["at"], row["name"], *(f"{row[gain]:.6g}" for gain in GAIN_NAMES), row["why"])
            for row in history.gains
        ]
        output.show_table(("at", "gain set", *GAIN_NAMES, "why"), sets)
        told = [(row["at"], row["verb"], row["sentence"]) for row in history.commands]
        output.show_table(("at", "verb", ""), told)


def _whoami() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a process without a user's name
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}"[:128]
