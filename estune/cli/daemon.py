"""`estune daemon` and `estune daemon-control`: rigs that are supervised for days."""

import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal

from rich.live import Live
from rich.text import Text

import estune.daemon
from estune.cli import output
from estune.cli.values import Flag, OptionalText, security_from, share_from
from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput, RigError
from estune.remote.messages.daemon import DaemonStatus, DaemonVerb, History
from estune.support.log_lines import LogFormat, begin_logging
from estune.support.user import user_at_host

if TYPE_CHECKING:
    from estune.remote.zenoh.daemon_service import DaemonClient

EXAMPLE = Path(estune.daemon.__file__).with_name("example.toml")
_TAKES_EFFECT_WITHIN_S = 10.0
"""Time for which a command is waited for; a rig that is away may take longer."""
_POLL_S = 0.1
_ENDED = "the daemon has ended; its log says which gains the rig confirmed"
_WATCH_EVERY_S = 1.0
_OVERVIEW = ("rig", "mode", "live", "run", "cost", "next check", "paused", "trouble")
"""The facts of a status in the table of all rigs."""


def daemon(
    config: Path | None = None,
    /,
    *,
    check: Flag = False,
    dither: str | None = None,
    security: Path | None = None,
    log_format: LogFormat = "auto",
    verbose: Flag = False,
    example: Flag = False,
) -> None:
    """Tune rigs, monitor the accepted gains, and tune again when the cost drifts; until stopped.

    Args:
        config: The daemon's file (TOML): the rigs, and for each when to tune and check it.
        check: Only check the file.
        dither: Multisine added to the setpoints of all rigs while they are watched, rms over the
            step, such as 1%; that of the file by default.
        security: Credentials file, if a rig requires authentication.
        log_format: JSON lines or text, on standard error; auto is text on a terminal.
        verbose: Log every check trial, too.
        example: Print a complete file and exit.
    """
    if example:
        print(EXAMPLE.read_text("utf-8"), end="")
        return
    if config is None:
        raise InvalidInput("give the daemon's file; for one to begin from, use --example")
    from estune.daemon.config import read_config  # noqa: PLC0415  slow to import
    from estune.daemon.config_check import check_file  # noqa: PLC0415
    from estune.daemon.service import DaemonService  # noqa: PLC0415  as above

    if check:
        rigs = check_file(config)
        print(f"{config}: {rigs} {'rig' if rigs == 1 else 'rigs'}, nothing wrong")
        return
    settings, credentials = read_config(config), security_from(security)
    if dither is not None:
        settings = settings.with_dither(share_from("--dither", dither))
    begin_logging(log_format, verbose=verbose)
    service = DaemonService(settings, security=credentials)

    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  a signal handler
        service.stop()

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    print(f"daemon at {service.endpoint}", flush=True)
    if service.page_address:
        print(f"page at {service.page_address}", flush=True)
    service.run()


def daemon_control(
    verb: Literal["status", "history", "events", DaemonVerb],
    endpoint: str,
    /,
    *,
    rig: str | None = None,
    why: OptionalText = "",
    limit: int = 20,
    watch: Flag = False,
    security: Path | None = None,
    json: Flag = False,
) -> None:
    """Query or command a daemon.

    Args:
        verb: Query or command.
        endpoint: Address of the daemon, such as tcp/127.0.0.1:7450.
        rig: The rig; may be left out if there is one only. The status of a named rig is a list
            with all of its gain sets, that of all rigs a table.
        why: Reason, for the daemon's history.
        limit: Maximum number of rows of history or events.
        watch: Show the status at each change, until Ctrl-C.
        security: Credentials file, if the daemon requires authentication.
        json: Print JSON; with --watch, a line for each change.
    """
    from estune.remote.zenoh.daemon_service import DaemonClient  # noqa: PLC0415  slow to import

    if watch and verb != "status":
        raise InvalidInput(f"--watch shows the status; leave it out with {verb}")
    with DaemonClient(endpoint, security=security_from(security)) as client:
        if watch:
            with suppress(KeyboardInterrupt):
                _watch(client, rig, json=json)
            return
        answer: Any
        statuses = _statuses(client, rig)
        names = [status.rig for status in statuses]
        if verb == "events":
            answer = [event for name in names for event in client.events(name, limit=limit)]
        elif verb == "history":
            answer = {name: client.history(name, limit) for name in names}
        elif verb == "status":
            answer = statuses if json or rig is None else statuses[0]
        elif len(names) > 1:
            raise InvalidInput(f"name the rig with --rig: {', '.join(names)}")
        else:
            reply = client.command(names[0], verb, user_at_host()[:128], why)
            if not json:
                print(reply, flush=True)
            answer = _status_after(client, statuses[0], verb)
    if json:
        output.print_json(answer)
    else:
        _show(verb, answer)


def _statuses(client: "DaemonClient", rig: str | None) -> list[DaemonStatus]:
    return client.statuses() if rig is None else [client.status(rig)]


def _status_after(client: "DaemonClient", status: DaemonStatus, verb: DaemonVerb) -> DaemonStatus:
    """The status once a command has taken effect; the latest if that takes long."""
    until_s = time.monotonic() + _TAKES_EFFECT_WITHIN_S
    while time.monotonic() < until_s:
        try:
            status = client.status(status.rig)
        except RigError:
            if verb != "stop":
                raise
            return replace(status, mode="stopped", live="", sentence=_ENDED)
        if verb == "stop":
            has_taken_effect = status.mode == "stopped"
        else:
            has_taken_effect = bool(status.live) and status.mode != "readying"
        if has_taken_effect:
            break
        time.sleep(_POLL_S)
    return status


def _watch(client: "DaemonClient", rig: str | None, *, json: bool) -> None:
    """Shows the status: on a terminal in place, else at each change."""
    out = output.console()
    if json or not out.is_terminal:
        shown: object = None
        for statuses in _status_at_intervals(client, rig):
            # Without the time to the next check, which changes by itself.
            lasting = [replace(s, next_check_s=None) for s in statuses] or None
            if lasting != shown and json:
                output.print_json_line(statuses)
            elif lasting != shown:
                out.print(_text(statuses))
            shown = lasting
        return
    with Live(console=out, auto_refresh=False) as live:
        for statuses in _status_at_intervals(client, rig):
            live.update(_text(statuses), refresh=True)


def _status_at_intervals(client: "DaemonClient", rig: str | None) -> Iterator[list[DaemonStatus]]:
    """The statuses again and again; none while the daemon does not answer."""
    while True:
        try:
            yield _statuses(client, rig)
        except RigError:
            yield []
        time.sleep(_WATCH_EVERY_S)


def _text(statuses: list[DaemonStatus]) -> Text:
    texts = [output.facts_text(_facts(status)) for status in statuses]
    return Text("\n\n").join(texts) if texts else Text("no daemon answers; asking again")


def _show(verb: str, answer: Any) -> None:
    if verb == "events":
        rows = [(output.local_time(e.at), e.rig, e.kind, e.sentence) for e in answer]
        output.show_table(("at", "rig", "event", ""), rows)
    elif verb == "history":
        for name, history in answer.items():
            _show_history(name, history)
    elif isinstance(answer, list):
        _show_statuses(answer)
    else:
        output.show_next(_facts(answer))


def _show_statuses(statuses: list[DaemonStatus]) -> None:
    """Prints a row for each rig, without what no rig has."""
    facts = [{**dict.fromkeys(_OVERVIEW, ""), **_facts(status)} for status in statuses]
    heads = [head for head in _OVERVIEW if any(one[head] for one in facts)]
    output.show_table(heads, ([str(one[head]) for head in heads] for one in facts))


def _facts(status: DaemonStatus) -> Mapping[str, object]:
    """The fields of a status that an operator sees, by name."""
    live = f"{status.live} gains" if status.live else "not confirmed by the rig at present"
    facts: dict[str, object] = {
        "rig": status.rig,
        "mode": f"{status.mode}: {status.sentence}",
        "live": f"{live}{_intended(status)}; {status.why}",
    }
    facts |= status.gains
    if status.found:
        facts["candidate is"] = status.found
    if status.run:
        limit = f" of {status.trials_max}" if status.trials_max else ""
        facts["run"] = f"{status.run}, {status.trials}{limit} trials"
    if status.baseline_cost is not None:
        drift = 0.0 if status.drift is None else status.drift
        last = "" if status.cost is None else f", last {status.cost:.4g}"
        facts["cost"] = f"{status.baseline_cost:.4g}{last}; drift {drift:+.0%} of the limit"
    if status.next_check_s is not None:
        facts["next check"] = f"in {status.next_check_s:.0f} s, {status.checks} so far"
    if status.margins:
        facts["margins"] = status.margins
    if status.behaviour is not None:
        tracking, reversal, rest = status.behaviour
        facts["tracking"] = f"error {tracking:.3g}, at reversals {reversal:.3g}, rest {rest:.3g}"
    facts |= {f"remedy {effect}": said for effect, said in status.remedies.items()}
    if status.paused:
        facts["paused"] = status.paused
    if status.trouble:
        facts["trouble"] = status.trouble
    return facts


def _intended(status: DaemonStatus) -> str:
    """The gains that the daemon maintains, where others are live."""
    return "" if status.live == status.home else f", to become the {status.home} ones"


def _show_history(rig: str, history: History) -> None:
    print(rig)
    sets = [
        (
            output.local_time(row["at"]),
            row["name"],
            *(f"{row[gain]:.6g}" for gain in GAIN_NAMES),
            row["why"],
        )
        for row in history.gains
    ]
    output.show_table(("at", "gain set", "P", "I", "D", "setpoint filter, s", "why"), sets)
    commands = [
        (output.local_time(row["at"]), row["verb"], row["sentence"]) for row in history.commands
    ]
    if commands:
        output.show_table(("at", "command", "answer"), commands)
