"""What does the code say of the rig protocol? Writes it into docs/rig-protocol.md.

The page's prose is written by hand; its tables, diagrams and bytes lie between markers and come
from the code, so that they cannot say anything else. Run it after the protocol has changed:
python -m experiments.rig_protocol_page
"""

import argparse
import inspect
import json
import re
import types
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.remote import messages
from estune.remote.messages import Answer, Description, Keys, Status
from estune.remote.state_machine import client, rig, state
from estune.remote.state_machine.client import ClientInput, ClientStage
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.remote.state_machine.trials import TABLE, TrialEvent, TrialState
from estune.remote.zenoh import rig_connection, rig_server, zenoh_session
from estune.trial import (
    LinearModel,
    Outcome,
    RigDescription,
    RigLimits,
    Telemetry,
    TrialRecord,
    TrialRequest,
    record_frame,
)
from estune.trial.profiles import PROFILES, StepProfile

PAGE = Path(__file__).parents[1] / "docs" / "rig-protocol.md"

GAINS = Gains(0.5, 20.0, 0.002, 0.01)
STEP = StepProfile(15.0, 5.0, 0.1, 1.0)
REQUEST = TrialRequest("monday", 7, GAINS, STEP)
LEASE = "5ad1e7c0ffee0042"
RECORD = TrialRecord(
    trial_id=REQUEST.trial_id,
    rig="reel",
    sampling_Hz=632.0,
    cable_length_m=0.8,
    preload_N=15.0,
    gains=GAINS,
    outcome=Outcome.GUARD,
    reason="tension above 45 N",
    started_at="2009-05-04T12:00:00.000+02:00",
    software="board 1.0",
    time_s=np.array([0.0, 1.0 / 632.0]),
    setpoint_N=np.array([15.0, 15.0]),
    tension_N=np.array([14.75, 45.5]),
    current_A=np.array([0.75, -6.0]),
    angle_rad=np.array([0.0, 0.25]),
    flags=np.array([0, 3], np.uint8),
)
SAMPLES = Telemetry(
    *(REQUEST.trial_id, 32, 632.0, np.array([15.0, 15.0])),
    *(np.array([14.75, 15.25]), np.array([0.75, 0.5]), np.array([0.0, 0.25])),
)
DESCRIBED = RigDescription(
    name="reel",
    gains=GAINS,
    controller=ControllerSettings(632.0, 0.001, -120.0, 120.0),
    newtons_per_ampere=20.0,
    limits=RigLimits(2.0, 45.0, 10.0),
    step=STEP,
    settling_time_s=0.25,
    cable_length_m=0.8,
    software="board 1.0",
)
EXAMPLES: tuple[Any, ...] = (
    messages.Lease("acquire", LEASE, "anna@lab, process 4711"),
    messages.Submit(LEASE, REQUEST, messages.digest(REQUEST)),
    messages.Cancel(LEASE, REQUEST.trial_id),
    messages.Void(LEASE, REQUEST.trial_id, messages.digest(REQUEST)),
    messages.SetGains(LEASE, GAINS),
    messages.Estop("anna: the cable smokes"),
    messages.Clear(),
    messages.Inquire(messages.digest(REQUEST), 1024, 1024),
    Answer(ReplyCode.HELD, sentence="the rig is held by anna@lab, process 4711"),
    Status("9f3c01aa", Mode.RUNNING, REQUEST.trial_id, 7, "anna@lab, process 4711", ""),
    Description(DESCRIBED, "9f3c01aa", "d1a5c0de00000001"),
)
PARTS = (TrialRequest, Gains, RigDescription, ControllerSettings, RigLimits, LinearModel)


def keys() -> Iterator[str]:
    """The keys, one a line."""
    made = Keys("<rig>")
    shown = (
        *((made.alive("<instance>"), "liveliness token"), (made.status, "queryable, published")),
        *((made.describe, "queryable"), (made.result("<trial id>"), "queryable")),
        *((made.command("<instance>", verb), "queryable") for verb in rig_server.VERBS),
        (made.telemetry("<trial id>"), "published, optional"),
    )
    yield "| key | what the rig declares there |\n| --- | --- |\n"
    for key, what in shown:
        yield f"| `{key}` | {what} |\n"


def message_examples() -> Iterator[str]:
    """Each message: its fields, and an example."""
    for example in EXAMPLES:
        kind = type(example)
        yield f"### {kind.__name__}\n\n{_title(kind)}\n\n"
        yield from _fields(kind)
        yield f"```json\n{messages.encode(example).decode()}\n```\n\n"


def parts() -> Iterator[str]:
    """The objects inside the messages."""
    for kind in PARTS:
        yield f"### {kind.__name__}\n\n{_title(kind)}\n\n"
        yield from _fields(kind)


def profiles() -> Iterator[str]:
    """What a trial may ask for, with the formulas."""
    for kind in PROFILES:
        text = inspect.getdoc(kind) or ""
        prose = text.split("Attributes:")[0].partition("\n")[2].strip("\n")
        yield f"### {kind.__name__}: `{_default(kind, 'kind')}`\n\n{_title(kind)}\n\n"
        yield f"```text\n{inspect.cleandoc(prose)}\n```\n\n" if prose else ""
        yield from _fields(kind)


def verdicts() -> Iterator[str]:
    """The words of an answer."""
    yield "| verdict | meaning |\n| --- | --- |\n"
    for verdict in ReplyCode:
        yield f"| `{verdict}` | {verdict.sentence} |\n"


def modes() -> Iterator[str]:
    """The modes of a rig, and what each event does in each."""
    yield "| mode | meaning |\n| --- | --- |\n"
    for mode in Mode:
        yield f"| `{mode}` | {mode.sentence} |\n"
    yield "\n"
    for event, row in rig.TABLE.items():
        yield f"**{event.__name__}**: {_title(event)}\n\n| in mode | then |\n| --- | --- |\n"
        by_handler: dict[rig.Handler, list[str]] = {}
        for mode, handler in row.items():
            by_handler.setdefault(handler, []).append(f"`{mode}`")
        for handler, columns in by_handler.items():
            yield f"| {', '.join(columns)} | {_title(handler)} |\n"
        yield "\n"


def trials() -> Iterator[str]:
    """The life of a trial id in the ledger."""
    yield f"| state | {' | '.join(TrialEvent)} |\n| --- |{' --- |' * len(TrialEvent)}\n"
    for trial in TrialState:
        cells = (f"{TABLE[trial].get(event, 'cannot be')}" for event in TrialEvent)
        yield f"| `{trial}` | {' | '.join(cells)} |\n"


def clients() -> Iterator[str]:
    """What a client does with what it hears."""
    stages = [stage for stage in ClientStage if stage is not ClientStage.OVER]
    yield f"| heard | {' | '.join(stages)} |\n| --- |{' --- |' * len(stages)}\n"
    for heard, row in client.TABLE.items():
        cells = ("cannot be" if s is None else f"{s.action} (`{s.stage}`)" for s in row)
        meaning = heard.sentence if isinstance(heard, ClientInput) else f"`{heard}`"
        yield f"| {meaning} | {' | '.join(cells)} |\n"


def outcomes() -> Iterator[str]:
    """How a trial may end."""
    yield "| outcome | meaning | void |\n| --- | --- | --- |\n"
    for outcome in Outcome:
        yield f"| `{outcome}` | {outcome.sentence} | {'yes' if outcome.is_void else 'no'} |\n"


def header() -> Iterator[str]:
    """The header of a record's frame."""
    yield from _fields(record_frame.Header, {f.name: f for f in fields(TrialRecord)})


def frame_bytes() -> Iterator[str]:
    """A whole frame, byte by byte."""
    yield from _hex(record_frame.encode(RECORD))


def part_bytes() -> Iterator[str]:
    """The first 32 bytes of that frame as a part."""
    yield from _hex(messages.encode_part(record_frame.encode(RECORD), 0, 32))


def live_bytes() -> Iterator[str]:
    """Live samples, byte by byte."""
    yield from _hex(messages.encode_live(SAMPLES))


def limits() -> Iterator[str]:
    """Every number that matters."""
    rows = (
        ("protocol version", messages.VERSION),
        ("lease, s", state.LEASE_S),
        ("renewed every, s", state.RENEW_S),
        ("largest command, bytes", messages.COMMAND_MAX_BYTES),
        ("largest JSON answer, bytes", messages.ANSWER_MAX_BYTES),
        ("largest frame, bytes", record_frame.MAX_BYTES),
        ("largest header of a frame, bytes", record_frame.HEADER_MAX_BYTES),
        ("largest number of live samples in a message", messages.LIVE_MAX_SAMPLES),
        ("longest holder and reason, characters", messages.HOLDER_MAX),
        ("a client waits for an answer, s", rig_connection.ASK_S),
        ("a client gives up a rig that is alive and silent after, s", rig_connection.HUNG_AFTER_S),
        ("transport lease of estune's own sessions, ms", zenoh_session.LEASE_MS),
    )
    yield "| what | value |\n| --- | --- |\n"
    for what, value in rows:
        yield f"| {what} | {value} |\n"


SECTIONS: dict[str, Callable[[], Iterator[str]]] = {
    made.__name__: made
    for made in (
        *(keys, message_examples, parts, profiles, verdicts, modes, trials, clients, outcomes),
        *(header, frame_bytes, part_bytes, live_bytes, limits),
    )
}

_SECTION = re.compile(r"(<!-- from the code: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """The page with all that comes from the code renewed."""

    def renewed(found: re.Match[str]) -> str:
        return f"{found[1]}\n{''.join(SECTIONS[found[2]]()).strip()}\n\n{found[3]}"

    return _SECTION.sub(renewed, text)


def _fields(kind: type, others: dict[str, Any] | None = None) -> Iterator[str]:
    """The fields of a message as a table."""
    if not fields(kind):
        yield "No fields: `{}`.\n\n"
        return
    hints, said = get_type_hints(kind), _attributes(kind)
    if others:
        said = _attributes(TrialRecord) | said
    yield "| field | type | meaning |\n| --- | --- | --- |\n"
    for field in fields(kind):
        default = "" if field.default is MISSING else f"; {_json(field.default)} if left out"
        meaning = said.get(field.name, _OWN.get(field.name, "")).replace("|", "\\|")
        yield f"| `{field.name}` | {_type(hints[field.name])}{default} | {meaning} |\n"
    yield "\n"


_OWN = {
    "columns": "The columns that follow, in this order: the five of a record, and `reference_N` "
    "if there is one. `flags` always comes last and is not named.",
    "samples": "Number of samples in each column.",
}


def _json(value: object) -> str:
    return f"`{json.dumps(value)}`"


_PLAIN: dict[Any, str] = {
    float: "number",
    int: "integer",
    str: "string",
    bool: "true or false",
    type(None): "null",
    Outcome: "an outcome",
    **dict.fromkeys(PROFILES, "a profile"),
    **dict.fromkeys((ReplyCode, Mode), "one of the words below"),
}


def _type(hint: Any) -> str:
    """A type in the words of JSON."""
    origin, inside = get_origin(hint), get_args(hint)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is Literal:
        return " or ".join(f"`{json.dumps(value)}`" for value in inside)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_type, inside)))
    if origin is tuple:
        return f"array of {_type(inside[0])}"
    name: str = hint.__name__
    return f"[{name}](#{name.lower()})"


def _title(thing: Any) -> str:
    text = inspect.getdoc(thing) or ""
    return text.split("\n")[0]


def _default(kind: type, name: str) -> str:
    return str(next(f.default for f in fields(kind) if f.name == name))


def _attributes(kind: type) -> dict[str, str]:
    """What a docstring says of each attribute."""
    text = inspect.getdoc(kind) or ""
    _, _, section = text.partition("Attributes:\n")
    found: dict[str, str] = {}
    name = ""
    for line in section.split("\n"):
        if not line.strip() and found:
            break
        if (match := re.match(r"    (\w+): (.*)", line)) is not None:
            name = match[1]
            found[name] = match[2]
        elif name:
            found[name] += f" {line.strip()}"
    return found


def _hex(data: bytes) -> Iterator[str]:
    """Bytes as a dump: offset, sixteen of them, and what of it is text."""
    yield "```text\n"
    for at in range(0, len(data), 16):
        line = data[at : at + 16]
        text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in line)
        yield f"{at:04x}  {line.hex(' '):47}  {text}".rstrip() + "\n"
    yield "```\n"


def main() -> None:
    """Renews the page."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
    print(f"{len(SECTIONS)} sections written: {PAGE}")


if __name__ == "__main__":
    main()
