"""Writes the generated sections of docs/reference/rig-protocol.md.

The prose of the page is written by hand. Its tables, examples and bytes lie between markers and
are made from the code. Run it after each change of the protocol:
./dev python -m tests.rig_protocol_page
"""

import argparse
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.remote import messages
from estune.remote.messages import VERBS, Keys
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
    TrialRecord,
    TrialRequest,
    record_frame,
)
from estune.trial.profiles import PROFILES
from experiments.inert_rig import RECORD
from tests.protocol_examples import EXAMPLES, SAMPLES
from tests.protocol_tables import (
    default,
    fields_table,
    hex_dump,
    link,
    message_section,
    table,
    title,
)

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "rig-protocol.md"

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
    yield from table(("key", "declared by the rig as"), ((f"`{k}`", what) for k, what in shown))


def verbs() -> Iterator[str]:
    """Commands and queries: key, message, lease, reply."""
    commands = (
        (
            f"`@cmd/<instance>/{name}`",
            link(verb.message.__name__),
            "yes" if verb.needs_lease else "no",
            verb.reply,
        )
        for name, verb in VERBS.items()
    )
    whole = "[Answer](#answer), the frame, or a part of it"
    queries = (
        ("`result/<trial id>`", link("Inquire"), "no", whole),
        ("`status`", "none", "no", link("Status")),
        ("`describe`", "none", "no", link("Description")),
    )
    yield from table(("sent to", "message", "needs the lease", "reply"), (*commands, *queries))


def message_examples() -> Iterator[str]:
    """Fields and an example of each message."""
    for example in EXAMPLES:
        yield from message_section(type(example))
        yield f"```json\n{messages.encode(example).decode()}\n```\n\n"


def parts() -> Iterator[str]:
    """Objects inside the messages."""
    for kind in PARTS:
        yield from message_section(kind)


def profiles() -> Iterator[str]:
    """Setpoint profiles, with their formulas."""
    for kind in PROFILES:
        text = inspect.getdoc(kind) or ""
        prose = text.split("Attributes:")[0].partition("\n")[2].strip("\n")
        yield f"### {kind.__name__}: `{default(kind, 'kind')}`\n\n{title(kind)}\n\n"
        yield f"```text\n{inspect.cleandoc(prose)}\n```\n\n" if prose else ""
        yield from fields_table(kind)


def verdicts() -> Iterator[str]:
    """Reply codes."""
    yield from table(("verdict", "meaning"), ((f"`{c}`", c.sentence) for c in ReplyCode))


def modes() -> Iterator[str]:
    """Modes of a rig, and the effect of each event in each mode."""
    yield from table(("mode", "meaning"), ((f"`{mode}`", mode.sentence) for mode in Mode))
    yield "\n"
    yield from printed(
        rig.TABLE, lambda kind: f"**{kind.__name__.removesuffix('Event')}**: {title(kind)}"
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
    yield from table(("in mode", *commands), rows)


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
    yield from table(("command", "reply", "mode before and after", "ordered"), rows)


def trials() -> Iterator[str]:
    """States of a trial id in the ledger, and the reply to a submit or Inquire."""
    rows = []
    for trial in TrialState:
        moves = (TABLE.cell(event, trial) for event in TrialEvent)
        cells = (move if isinstance(move, str) else f"{move(trial)}" for move in moves)
        reply = "the frame" if trial is TrialState.ENDED else f"`{OF_TRIAL[trial]}`"
        reply += ", with the error in the ledger" if trial is TrialState.FAILED else ""
        rows.append((f"`{trial}`", *cells, reply))
    yield from table(("state", *TrialEvent, "reply to an Inquire"), rows)


def clients() -> Iterator[str]:
    """Transitions of a client."""
    stages = [stage for stage in ClientStage if stage is not ClientStage.OVER]
    rows = []
    for heard, row in client.TABLE.rows.items():
        moves = (row[stage] for stage in stages)
        cells = (IMPOSSIBLE if isinstance(m, str) else sentence_of(m) for m in moves)
        meaning = heard.sentence if isinstance(heard, ClientInput) else f"`{heard}`"
        rows.append((meaning, *cells))
    yield from table(("input", *stages), rows)


def outcomes() -> Iterator[str]:
    """Outcomes of a trial."""
    rows = ((f"`{o}`", o.sentence, "yes" if o.is_void else "no") for o in Outcome)
    yield from table(("outcome", "meaning", "void"), rows)


def header() -> Iterator[str]:
    """Header of a record's frame."""
    yield from fields_table(record_frame.Header, {f.name: f for f in fields(TrialRecord)})


def frame_bytes() -> Iterator[str]:
    """A complete frame."""
    yield from hex_dump(record_frame.encode(RECORD))


def part_bytes() -> Iterator[str]:
    """A part of that frame: its first 32 bytes."""
    yield from hex_dump(messages.encode_part(record_frame.encode(RECORD), 0, 32))


def live_bytes() -> Iterator[str]:
    """Live samples of a trial."""
    yield from hex_dump(messages.encode_live(SAMPLES))


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
    yield from table(("what", "value"), rows)


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


def main() -> None:
    """Updates the page."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
    print(f"{len(SECTIONS)} sections written: {PAGE}")


if __name__ == "__main__":
    main()
