"""Writes the generated sections of docs/reference/rig-protocol.md.

The prose of the page is written by hand. Its tables, examples and bytes lie between markers and
are made from the code. Run it after each change of the protocol:
./dev python -m tests.rig_protocol_page
"""

import argparse
import inspect
import json
import re
import types
from collections.abc import Callable, Iterable, Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.remote import messages
from estune.remote.messages import VERBS, Answer, Description, Following, Inquire, Keys, Status
from estune.remote.messages.codec import Message
from estune.remote.messages.replies import Failure
from estune.remote.state_machine import client, events, rig, state
from estune.remote.state_machine.client import ClientInput, ClientStage
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import Mode
from estune.remote.state_machine.trials import TABLE, TrialEvent, TrialState
from estune.remote.zenoh import rig_connection, zenoh_session
from estune.support.state_table import IMPOSSIBLE, printed, sentence_of
from estune.trial import (
    SETPOINT_S,
    Feedback,
    LinearModel,
    Outcome,
    RigDescription,
    RigLimits,
    Setpoint,
    Telemetry,
    TrialRecord,
    TrialRequest,
    record_frame,
)
from estune.trial.profiles import PROFILES
from experiments.inert_rig import DESCRIBED, GAINS, RECORD, REQUEST

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "rig-protocol.md"

LEASE = "5ad1e7c0ffee0042"
SAMPLES = Telemetry(
    *(REQUEST.trial_id, 32, 632.0, np.array([15.0, 15.0])),
    *(np.array([14.75, 15.25]), np.array([0.75, 0.5]), np.array([0.0, 0.25])),
)
VALUES: dict[str, Any] = {
    "action": "acquire",
    "lease": LEASE,
    "holder": "anna@lab, process 4711",
    "request": REQUEST,
    "digest": messages.digest(REQUEST),
    "trial_id": REQUEST.trial_id,
    "gains": GAINS,
    "reason": "anna: the cable smokes",
    "sent_s": 4711.25,
    "setpoint": Setpoint(18.5),
}
"""Values of the fields of the example commands, by name; others have those of their type."""
OF_TYPE = {float: 2.5, int: 3, str: "a text", bool: True}


def _example(kind: Any) -> Message:
    hints = get_type_hints(kind)
    made: Message = kind(
        **{f.name: VALUES.get(f.name, OF_TYPE.get(hints[f.name])) for f in fields(kind)}
    )
    return made


COMMANDS: dict[str, Message] = {name: _example(verb.message) for name, verb in VERBS.items()}
EXAMPLES: tuple[Any, ...] = (
    *COMMANDS.values(),
    Inquire(messages.digest(REQUEST), 1024, 1024),
    Following(4711.25, Feedback(86.125, 18.25, -3.5, 0.875)),
    Answer(ReplyCode.HELD, sentence="the rig is held by anna@lab, process 4711"),
    Status("9f3c01aa", Mode.RUNNING, REQUEST.trial_id, 7, "anna@lab, process 4711", ""),
    Description(DESCRIBED, "9f3c01aa", "d1a5c0de00000001"),
    Failure("rig drum: the gauge's cable is broken; check the rig, then start it anew"),
)
PARTS = (
    TrialRequest,
    Gains,
    Setpoint,
    Feedback,
    RigDescription,
    ControllerSettings,
    ControllerForm,
    RigLimits,
    LinearModel,
)


def keys() -> Iterator[str]:
    """Keys of a rig."""
    made = Keys("<rig>")
    shown = (
        *((made.alive("<instance>"), "liveliness token"), (made.status, "queryable, published")),
        *((made.describe, "queryable"), (made.result("<trial id>"), "queryable")),
        *((made.command("<instance>", verb), "queryable") for verb in VERBS),
        (made.telemetry("<trial id>"), "published, optional"),
        (made.failure, "published, optional"),
    )
    yield from _table(("key", "declared by the rig as"), ((f"`{k}`", what) for k, what in shown))


def verbs() -> Iterator[str]:
    """Commands and queries: key, message, lease, reply."""
    commands = (
        (
            f"`@cmd/<instance>/{name}`",
            _link(verb.message.__name__),
            "yes" if verb.needs_lease else "no",
            verb.reply,
        )
        for name, verb in VERBS.items()
    )
    whole = "[Answer](#answer), the frame, or a part of it"
    queries = (
        ("`result/<trial id>`", _link("Inquire"), "no", whole),
        ("`status`", "none", "no", _link("Status")),
        ("`describe`", "none", "no", _link("Description")),
    )
    yield from _table(("sent to", "message", "needs the lease", "reply"), (*commands, *queries))


def message_examples() -> Iterator[str]:
    """Fields and an example of each message."""
    for example in EXAMPLES:
        yield from _object(type(example))
        yield f"```json\n{messages.encode(example).decode()}\n```\n\n"


def parts() -> Iterator[str]:
    """Objects inside the messages."""
    for kind in PARTS:
        yield from _object(kind)


def profiles() -> Iterator[str]:
    """Setpoint profiles, with their formulas."""
    for kind in PROFILES:
        text = inspect.getdoc(kind) or ""
        prose = text.split("Attributes:")[0].partition("\n")[2].strip("\n")
        yield f"### {kind.__name__}: `{_default(kind, 'kind')}`\n\n{_title(kind)}\n\n"
        yield f"```text\n{inspect.cleandoc(prose)}\n```\n\n" if prose else ""
        yield from _fields(kind)


def verdicts() -> Iterator[str]:
    """Reply codes."""
    yield from _table(("verdict", "meaning"), ((f"`{c}`", c.sentence) for c in ReplyCode))


def modes() -> Iterator[str]:
    """Modes of a rig, and the effect of each event in each mode."""
    yield from _table(("mode", "meaning"), ((f"`{mode}`", mode.sentence) for mode in Mode))
    yield "\n"
    yield from printed(
        rig.TABLE, lambda kind: f"**{kind.__name__.removesuffix('Event')}**: {_title(kind)}"
    )


UNKNOWN = TrialState.UNKNOWN
HELD = state.RigState(state.GrantedLease("right", "anna", 1.0))
ACTIVE, NOTED, RUNNING, STOPPING = (
    HELD._replace(trial=state.AcceptedTrial("active", *progress))
    for progress in ((), (True,), (True, True), (True, True, "a reason"))
)
SAFE = HELD._replace(latched="the first reason")
CLOSED = state.RigState(closed=True)
STATES = (state.RigState(), HELD, ACTIVE, NOTED, RUNNING, STOPPING, SAFE, CLOSED)
"""A state in each mode, in their order; the lease, where one is held, is `right`."""


def submits() -> Iterator[str]:
    """Reply to a submit that has not been refused as a message, in each mode."""
    commands = {
        "the ledger has an entry": events.SubmitEvent("wrong", "id", TrialState.ENDED, "outside"),
        "else, the lease is not its": events.SubmitEvent("wrong", "id", UNKNOWN, "outside"),
        "else, outside the limits": events.SubmitEvent("right", "id", UNKNOWN, "outside"),
        "else": events.SubmitEvent("right", "id", UNKNOWN),
    }
    rows = []
    for before in STATES:
        codes = [rig.step(before, event, 0.0).reply_code for event in commands.values()]
        rows.append((f"`{before.mode}`", "its state", *(f"`{code}`" for code in codes[1:])))
    yield from _table(("in mode", *commands), rows)


CASES: tuple[tuple[str, state.RigState, events.Event], ...] = (
    ("renew, while another client holds the lease", HELD, events.Renew("wrong")),
    ("release, while another client holds the lease", HELD, events.Release("wrong")),
    ("renew, without any lease in force", state.RigState(), events.Renew("wrong")),
    ("release, without any lease in force", state.RigState(), events.Release("wrong")),
    ("cancel of another trial than the active one", RUNNING, events.CancelEvent("right", "id")),
    (
        "cancel of a trial, while another client holds the lease",
        RUNNING,
        events.CancelEvent("wrong"),
    ),
    (
        "void of a trial in the ledger, without the lease",
        HELD,
        events.VoidEvent("wrong", "id", TrialState.ENDED),
    ),
    (
        "void of a trial not in the ledger, without the lease",
        HELD,
        events.VoidEvent("wrong", "id", UNKNOWN),
    ),
    (
        "void of the trial that is being written to the ledger",
        ACTIVE,
        events.VoidEvent("right", "active", UNKNOWN),
    ),
    ("gains, while a trial is active", RUNNING, events.SetGainsEvent("right")),
    ("gains, in the safe state and without the lease", SAFE, events.SetGainsEvent("wrong")),
    ("follow, while a trial is active", RUNNING, events.FollowEvent("right")),
    ("follow, while another client holds the lease", HELD, events.FollowEvent("wrong")),
    ("follow, in the safe state and without the lease", SAFE, events.FollowEvent("wrong")),
    ("estop, in the safe state: the first reason stands", SAFE, events.EstopEvent("another")),
    ("clear, by a client without the lease", SAFE, events.ClearEvent()),
)
"""Questions that the sentences of the table leave open: situation, state before it, event."""


def cases() -> Iterator[str]:
    """Replies in particular situations."""
    rows = []
    for situation, before, event in CASES:
        move = rig.step(before, event, 0.0)
        orders = ", ".join(order.value for order in move.orders) or "nothing"
        modes = f"`{before.mode}`, `{move.state.mode}`"
        rows.append((situation, f"`{move.reply_code}`", modes, orders))
    yield from _table(("command", "reply", "mode before and after", "ordered"), rows)


def trials() -> Iterator[str]:
    """States of a trial id in the ledger, and the reply to a submit or Inquire."""
    rows = []
    for trial in TrialState:
        moves = (TABLE.cell(event, trial) for event in TrialEvent)
        cells = (move if isinstance(move, str) else f"{move(trial)}" for move in moves)
        reply = "the frame" if trial is TrialState.ENDED else f"`{OF_TRIAL[trial]}`"
        reply += ", with the error in the ledger" if trial is TrialState.FAILED else ""
        rows.append((f"`{trial}`", *cells, reply))
    yield from _table(("state", *TrialEvent, "reply to an Inquire"), rows)


def clients() -> Iterator[str]:
    """Transitions of a client."""
    stages = [stage for stage in ClientStage if stage is not ClientStage.OVER]
    rows = []
    for heard, row in client.TABLE.rows.items():
        moves = (row[stage] for stage in stages)
        cells = (IMPOSSIBLE if isinstance(m, str) else sentence_of(m) for m in moves)
        meaning = heard.sentence if isinstance(heard, ClientInput) else f"`{heard}`"
        rows.append((meaning, *cells))
    yield from _table(("input", *stages), rows)


def outcomes() -> Iterator[str]:
    """Outcomes of a trial."""
    rows = ((f"`{o}`", o.sentence, "yes" if o.is_void else "no") for o in Outcome)
    yield from _table(("outcome", "meaning", "void"), rows)


def header() -> Iterator[str]:
    """Header of a record's frame."""
    yield from _fields(record_frame.Header, {f.name: f for f in fields(TrialRecord)})


def frame_bytes() -> Iterator[str]:
    """A complete frame."""
    yield from _hex(record_frame.encode(RECORD))


def part_bytes() -> Iterator[str]:
    """A part of that frame: its first 32 bytes."""
    yield from _hex(messages.encode_part(record_frame.encode(RECORD), 0, 32))


def live_bytes() -> Iterator[str]:
    """Live samples of a trial."""
    yield from _hex(messages.encode_live(SAMPLES))


def limits() -> Iterator[str]:
    """Limits and times."""
    rows = (
        ("protocol version", messages.VERSION),
        ("lease, s", state.LEASE_S),
        ("renewal interval of the lease, s", state.RENEW_S),
        ("time a setpoint is in force, s", SETPOINT_S),
        ("largest command, bytes", messages.COMMAND_MAX_BYTES),
        ("largest JSON reply, bytes", messages.ANSWER_MAX_BYTES),
        ("largest frame, bytes", record_frame.MAX_BYTES),
        ("largest header of a frame, bytes", record_frame.HEADER_MAX_BYTES),
        ("largest number of live samples in a message", messages.LIVE_MAX_SAMPLES),
        ("longest holder and reason, characters", messages.HOLDER_MAX),
        ("timeout of a client's query, s", rig_connection.ASK_S),
        ("time for which a client waits for a silent rig, by default, s", client.PATIENCE_S),
        ("transport lease of estune's sessions, ms", zenoh_session.LEASE_MS),
    )
    yield from _table(("what", "value"), rows)


SECTIONS: dict[str, Callable[[], Iterator[str]]] = {
    made.__name__: made
    for made in (
        *(keys, verbs, message_examples, parts, profiles, verdicts, modes, submits, cases),
        *(trials, clients, outcomes, header, frame_bytes, part_bytes, live_bytes, limits),
    )
}

_SECTION = re.compile(r"(<!-- from the code: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """The page with its generated sections renewed."""

    def renewed(found: re.Match[str]) -> str:
        return f"{found[1]}\n{''.join(SECTIONS[found[2]]()).strip()}\n\n{found[3]}"

    return _SECTION.sub(renewed, text)


def _table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> Iterator[str]:
    columns = tuple(head)
    for row in (columns, ("---",) * len(columns), *rows):
        yield f"| {' | '.join(map(str, row))} |\n"


def _object(kind: type) -> Iterator[str]:
    """Name, meaning and fields of a message."""
    yield f"### {kind.__name__}\n\n{_title(kind)}\n\n"
    yield from _fields(kind)


def _fields(kind: type, others: dict[str, Any] | None = None) -> Iterator[str]:
    """The fields of a message as a table."""
    if not fields(kind):
        yield "No fields: `{}`.\n\n"
        return
    hints, meanings = get_type_hints(kind), _attributes(kind)
    if others:
        meanings = _attributes(TrialRecord) | meanings
    rows = []
    for field in fields(kind):
        default = "" if field.default is MISSING else f"; default {_json(field.default)}"
        meaning = meanings.get(field.name, _OWN.get(field.name, "")).replace("|", "\\|")
        rows.append((f"`{field.name}`", f"{_type(hints[field.name])}{default}", meaning))
    yield from _table(("field", "type", "meaning"), rows)
    yield "\n"


_OWN = {
    "columns": "The columns that follow, in this order: the five of a record, and those "
    "of the optional ones that there are. `flags` is always the last and is not named.",
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
    ReplyCode: "a reply code",
    Mode: "a mode",
}


def _type(hint: Any) -> str:
    """JSON name of a type."""
    origin, inside = get_origin(hint), get_args(hint)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is Literal:
        return " or ".join(f"`{json.dumps(value)}`" for value in inside)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_type, inside)))
    if origin is tuple:
        return f"array of {_type(inside[0])}"
    return _link(hint.__name__)


def _link(name: str) -> str:
    return f"[{name}](#{name.lower()})"


def _title(thing: Any) -> str:
    text = inspect.getdoc(thing) or ""
    return text.split("\n")[0]


def _default(kind: type, name: str) -> str:
    return str(next(f.default for f in fields(kind) if f.name == name))


def _attributes(kind: type) -> dict[str, str]:
    """Meanings of the attributes, from a docstring."""
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
    """Hexadecimal dump: offset, sixteen bytes, and their text."""
    yield "```text\n"
    for at in range(0, len(data), 16):
        line = data[at : at + 16]
        text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in line)
        yield f"{at:04x}  {line.hex(' '):47}  {text}".rstrip() + "\n"
    yield "```\n"


def main() -> None:
    """Updates the page."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
    print(f"{len(SECTIONS)} sections written: {PAGE}")


if __name__ == "__main__":
    main()
