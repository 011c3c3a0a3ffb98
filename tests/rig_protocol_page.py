"""Writes the generated sections of the pages on the rig protocol, its options and security.

The prose of the pages is written by hand. Its tables, examples and bytes lie between markers and
are made from the code. Run it after each change of the protocol:
./dev python -m tests.rig_protocol_page
"""

import argparse
import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.remote import messages
from estune.remote.messages import VERBS, Failure, Following, Keys
from estune.remote.messages.commands import VERB_OF, Follow, SwitchOff
from estune.remote.messages.rights import Right
from estune.remote.state_machine import rig, state
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import Mode
from estune.remote.state_machine.trials import TABLE, TrialEvent, TrialState
from estune.remote.zenoh import rig_connection
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
from estune.trial.gain_bounds import GainBounds
from experiments.inert_rig import RECORD
from tests.protocol_examples import EXAMPLES, SAMPLES
from tests.protocol_tables import (
    PROFILES,
    fields_list,
    hex_dump,
    message_section,
    profile_sections,
    table,
)
from tests.state_tables import matrix

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"
PAGE = REFERENCE / "rig-protocol.md"
PAGES = (PAGE, REFERENCE / "rig-options.md", REFERENCE.parent / "how-to" / "security.md")

PARTS = (TrialRequest, Gains, RigDescription, ControllerSettings, RigLimits)
OPTIONAL_PARTS = (Setpoint, Feedback, ControllerForm, LinearModel, GainBounds)
OPTIONAL_MESSAGES = (SwitchOff, Follow, Following, Failure)


def keys() -> Iterator[str]:
    """Keys of a rig."""
    made = Keys("<rig>")
    shown = (
        *((made.alive("<instance>"), "liveliness token"), (made.status, "queryable, published")),
        *((made.describe, "queryable"), (made.result("<trial id>"), "queryable")),
        (made.command("<instance>", "<verb>"), "queryable, for each verb of section 3"),
    )
    yield from table(("key", "declared by the rig as"), ((f"`{k}`", what) for k, what in shown))


def message_examples() -> Iterator[str]:
    """Messages of every rig: where to, reply, fields, an example of each."""
    yield from _messages(lambda message: not isinstance(message, OPTIONAL_MESSAGES))


def optional_messages() -> Iterator[str]:
    """Messages that a rig may leave out."""
    for text in _messages(lambda message: isinstance(message, OPTIONAL_MESSAGES)):
        yield text.replace("(#answer)", "(rig-protocol.md#answer)")


def _messages(is_shown: Callable[[object], bool]) -> Iterator[str]:
    known: set[tuple[str, str]] = set()
    for example in filter(is_shown, EXAMPLES):
        kind = type(example)
        name = VERB_OF.get(kind)
        reply = f"\n\nTo `@cmd/<instance>/{name}`. Reply: {VERBS[name].reply}." if name else ""
        yield from message_section(kind, reply, known)
        yield f"```json\n{messages.encode(example).decode()}\n```\n\n"


def parts() -> Iterator[str]:
    """Objects inside the messages."""
    for kind in PARTS:
        yield from message_section(kind)


def optional_parts() -> Iterator[str]:
    """Objects inside the messages that a rig may leave out."""
    for kind in OPTIONAL_PARTS:
        yield from message_section(kind)


def step_profile() -> Iterator[str]:
    """The profile that every rig has."""
    yield from profile_sections(PROFILES[:1])


def profiles() -> Iterator[str]:
    """The other profiles, on a page of their own."""
    yield from profile_sections(PROFILES[1:], {f.name for f in fields(PROFILES[0])})


def verdicts() -> Iterator[str]:
    """Reply codes."""
    yield from (f"* `{code}`: {code.sentence}\n" for code in ReplyCode)


def modes() -> Iterator[str]:
    """Modes of a rig, and the action on each event in each mode."""
    yield from (f"* `{mode}`: {mode.sentence}\n" for mode in Mode)
    yield "\n"
    yield from matrix(rig.TABLE, lambda kind: kind.__name__.removesuffix("Event"))


def trials() -> Iterator[str]:
    """States of a trial id in the ledger, and the reply to a submit or Inquire."""
    rows = []
    for trial in TrialState:
        moves = (TABLE.cell(event, trial) for event in TrialEvent)
        cells = ("" if isinstance(move, str) else f"{move(trial)}" for move in moves)
        reply = "the frame" if trial is TrialState.ENDED else f"`{OF_TRIAL[trial]}`"
        reply += ", with the error in the ledger" if trial is TrialState.FAILED else ""
        rows.append((f"`{trial}`", *cells, reply))
    yield from table(("state", *TrialEvent, "reply to an Inquire"), rows)


def outcomes() -> Iterator[str]:
    """Outcomes of a trial."""
    for outcome in Outcome:
        yield f"* `{outcome}`{' (void)' if outcome.is_void else ''}: {outcome.sentence}\n"


def header() -> Iterator[str]:
    """Header of a record's frame."""
    yield from fields_list(record_frame.Header, TrialRecord)


def frame_bytes() -> Iterator[str]:
    """A complete frame."""
    yield from hex_dump(record_frame.encode(RECORD))


def part_bytes() -> Iterator[str]:
    """A part of that frame: its first 32 bytes."""
    yield from hex_dump(messages.encode_part(record_frame.encode(RECORD), 0, 32))


def live_bytes() -> Iterator[str]:
    """Live samples of a trial."""
    yield from hex_dump(messages.encode_live(SAMPLES))


def rights() -> Iterator[str]:
    """What each right adds to those above it."""
    seen = {Right.LOOK: ["descriptions, states, records, live samples"]}
    rows = (
        (f"`{right}`", ", ".join([*seen.get(right, []), *(f"`{n}`" for n in verbs)]))
        for right in Right
        for verbs in [[name for name, verb in VERBS.items() if verb.right is right]]
    )
    yield from table(("right", "adds"), rows)


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
    )
    yield from (f"* {what}: {value}\n" for what, value in rows)


SECTIONS: dict[str, Callable[[], Iterator[str]]] = {
    made.__name__: made
    for made in (
        *(keys, message_examples, optional_messages, parts, optional_parts, step_profile),
        *(profiles, verdicts, modes),
        *(trials, outcomes, header, frame_bytes, part_bytes, live_bytes, limits, rights),
    )
}

_SECTION = re.compile(r"(<!-- from the code: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """A page with its generated sections renewed."""

    def renewed(found: re.Match[str]) -> str:
        return f"{found[1]}\n{''.join(SECTIONS[found[2]]()).strip()}\n\n{found[3]}"

    return _SECTION.sub(renewed, text)


def main() -> None:
    """Updates the pages."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for path in PAGES:
        path.write_text(page(path.read_text("utf-8")), "utf-8")
        print(f"written: {path}")


if __name__ == "__main__":
    main()
