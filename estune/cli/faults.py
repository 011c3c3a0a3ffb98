"""`estune faults`: what has failed, by codes that do not change, with a remedy for each."""

import json as json_text
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from estune.cli import output
from estune.cli.values import Json, security_from
from estune.errors import InvalidInput

_EVENTS = 1000
_STOP = "stop-*.json"


class FaultRow(NamedTuple):
    """One fault of a rig."""

    at: str
    rig: str
    fault: str
    sentence: str
    remedy: str


def faults(
    source: str,
    /,
    *,
    rig: str | None = None,
    limit: int = 50,
    security: Path | None = None,
    json: Json = False,
) -> None:
    """Show the faults of rigs, oldest first: when, which code, what was said, what to do.

    Args:
        source: A daemon's endpoint, its state folder where it does not run, or the folder of a
            rig's black box.
        rig: The rig; all of them by default.
        limit: Largest number of faults, the newest.
        security: Credentials file, if the daemon requires authentication.

    Raises:
        InvalidInput: the source is none of these.
    """
    from estune.run.targets import is_endpoint  # noqa: PLC0415  slow to import

    folder = Path(source)
    if is_endpoint(source):
        found = _of_daemon(source, rig, security)
    elif any(folder.glob(_STOP)):
        found = _of_black_box(folder)
    elif folder.is_dir():
        found = _of_stores(folder)
    else:
        raise InvalidInput(
            f"{source} is no endpoint and no folder; give a daemon's endpoint or state folder, or "
            "the folder of a rig's black box"
        )
    rows = sorted(row for row in found if rig in (None, row.rig))[-limit:]
    if json:
        output.print_json([row._asdict() for row in rows])
    elif rows:
        shown = ((output.local_time(row.at), *row[1:]) for row in rows)
        output.show_table(("at", "rig", "fault", "", "remedy"), shown)
    else:
        print("no faults")


def _of_daemon(endpoint: str, rig: str | None, security: Path | None) -> Iterator[FaultRow]:
    from estune.remote.zenoh.daemon_service import DaemonClient  # noqa: PLC0415  slow to import

    with DaemonClient(endpoint, security=security_from(security)) as client:
        for name in (rig,) if rig else client.rigs():
            for event in client.events(name, limit=_EVENTS):
                yield from _row(event.at, name, event.facts, event.sentence)


def _of_stores(folder: Path) -> Iterator[FaultRow]:
    from estune.daemon.store import FILE_NAME, ROWS_KEPT, DaemonStore  # noqa: PLC0415  as above

    files = sorted([*folder.glob(FILE_NAME), *folder.glob(f"*/{FILE_NAME}")])
    if not files:
        raise InvalidInput(
            f"{folder} holds neither the state of a daemon nor stops of a black box; give the "
            "folder `state` of the daemon's file, or <rig>-blackbox"
        )
    for file in files:
        store = DaemonStore.read(file.parent)
        for event in store.events(-1, ROWS_KEPT):
            yield from _row(event.at, store.rig, event.facts, event.sentence)
        store.close()


def _row(at: str, rig: str, facts: dict[str, object], sentence: str) -> Iterator[FaultRow]:
    from estune.daemon.faults import FAULT, FaultCode  # noqa: PLC0415  as above

    if code := str(facts.get(FAULT, "")):
        known = code in list(FaultCode)  # one of a later version is shown without its remedy
        yield FaultRow(at, rig, code, sentence, FaultCode(code).sentence if known else "")


def _of_black_box(folder: Path) -> Iterator[FaultRow]:
    for path in sorted(folder.glob(_STOP)):
        stop = json_text.loads(path.read_text("utf-8"))
        remedy = f"estune records {path.with_suffix('.blackbox')}"
        yield FaultRow(stop["at"], stop["rig"], "rig-stopped", stop["reason"], remedy)
