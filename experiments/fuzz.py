"""Does anything that can be sent to a rig or a client break it, or pass for what it is not?

Takes valid frames, parts, live samples, commands and answers, changes them at random (bits, bytes,
pieces cut out, repeated or swapped with another message's, numbers in the JSON made extreme), and
puts each where it would arrive. A frame, a part, live samples and a submit carry a checksum: a
changed one must be refused. Anything else must be refused, or be valid as it stands. Each query
must have one answer that can be understood, nothing but an error estune can name may be raised,
and the rig must have run the trials that were really asked for and no other.
"""

import logging
import re
from collections import Counter
from dataclasses import replace
from random import Random

from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.remote import messages
from estune.remote.ledger import MemoryLedger
from estune.remote.messages import (
    Answer,
    Cancel,
    Clear,
    Description,
    Estop,
    Inquire,
    Lease,
    SetGains,
    Status,
    Submit,
    Void,
    digest,
)
from estune.remote.zenoh.dispatcher import MessageDispatcher
from estune.remote.zenoh.request_handler import RequestHandler
from estune.trial import RigDescription, TrialRecord, TrialRequest, empty_record, record_frame
from estune.trial.profiles import (
    AnyProfile,
    ChirpProfile,
    MultisineProfile,
    StaircaseProfile,
    TriangleProfile,
)
from experiments.judged import at_most, command_line, tell
from experiments.rig_protocol_page import DESCRIBED, EXAMPLES, GAINS, RECORD, REQUEST, SAMPLES

MUTATIONS, QUICK = 120_000, 6_000
HELD = "5ad1e7c0ffee0042"
"""The lease."""

EXTREMES = (
    *("NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1e308", "5e-324", "-0.0", "0"),
    *("9223372036854775808", "1" * 400, "true", "null", '"1"', "[]", "{}", "-1", "0.5"),
)

Message = tuple[str, bytes]
"""Where it goes, and its bytes."""


class CountingRig:
    """Runs nothing, and counts what it was asked to run."""

    def __init__(self) -> None:
        self.asked: list[TrialRequest] = []
        self._live = GAINS

    def describe(self) -> RigDescription:
        """What it would be."""
        return replace(DESCRIBED, gains=self._live, simulated=True)

    def run(self, request: TrialRequest) -> TrialRecord:
        """A record without samples."""
        self.asked.append(request)
        record = empty_record(request, self.describe(), RECORD.outcome, "", RECORD.started_at)
        return replace(record, gains=request.gains)

    def apply(self, gains: Gains) -> None:
        """Nothing is live here."""

    def abort(self) -> RigDescription:
        """Nothing is ever under way."""
        return self.describe()

    def estop(self, reason: str) -> None:
        """Nothing ever moves here."""

    def clear(self) -> None:
        """Nothing was stopped."""

    def close(self) -> None:
        """Nothing is held."""


PROFILES: tuple[AnyProfile, ...] = (
    REQUEST.profile,
    TriangleProfile(15.0, 5.0, 0.2, 0.5, 0.1, shrink=0.5),
    MultisineProfile(15.0, 1.0, 0.2, 1, 15, 0.5, 0.1, lines="odd_sparse"),
    ChirpProfile(15.0, 2.0, 0.0, 30.0, 0.5, 0.1),
    StaircaseProfile(15.0, 2.0, 3, 0.05, 0.5, 0.1),
)


def seeds() -> list[Message]:
    """Valid messages of every kind but `submit`, and where they go."""
    whole = record_frame.encode(RECORD)
    commands: list[tuple[str, object]] = [
        *((f"result/{REQUEST.trial_id}", Inquire(digest(REQUEST), n, n)) for n in (0, 8)),
        ("@cmd/0f/lease", Lease("renew", HELD, "fuzz")),
        ("@cmd/0f/cancel", Cancel(HELD)),
        ("@cmd/0f/void", Void(HELD, "other-00001", digest(REQUEST))),
        ("@cmd/0f/gains", SetGains(HELD, GAINS)),
        ("@cmd/0f/estop", Estop("fuzz")),
        ("@cmd/0f/clear", Clear()),
    ]
    answers = [e for e in EXAMPLES if isinstance(e, Answer | Status | Description)]
    return [
        *((where, messages.encode(message)) for where, message in commands),
        *((f"decode/{type(a).__name__}", messages.encode(a)) for a in answers),
        ("decode/frame", whole),
        ("decode/part", messages.encode_part(whole, 16, 100)),
        ("decode/live", messages.encode_live(SAMPLES)),
    ]


def mutated(random: Random, data: bytes, others: list[Message]) -> bytes:
    """The bytes with one to four changes."""
    for _ in range(random.randint(1, 4)):
        at, to = sorted((random.randint(0, len(data)), random.randint(0, len(data))))
        piece = data[at:to]
        match random.randrange(8):
            case 0 if data:
                place = random.randrange(len(data))
                flipped = data[place] ^ 1 << random.randrange(8)
                data = data[:place] + bytes([flipped]) + data[place + 1 :]
            case 1 if data:
                place = random.randrange(len(data))
                data = data[:place] + random.randbytes(1) + data[place + 1 :]
            case 2:
                data = data[:at] + data[to:]
            case 3:
                data = data[:to] + piece + data[to:]
            case 4:
                data = data[:at]
            case 5:
                data = data[:at] + random.randbytes(random.randint(1, 8)) + data[at:]
            case 6:
                other = random.choice(others)[1]
                data = data[:at] + other[at:to] + data[to:]
            case _:
                data = _with_extreme(random, data)
    return data


def _with_extreme(random: Random, data: bytes) -> bytes:
    """One value of a JSON text made extreme."""
    values = list(re.finditer(rb'(?<=:)(-?\d[\d.eE+-]*|"[^"]*"|true|false|null)', data))
    if not values:
        return data
    value = random.choice(values)
    return data[: value.start()] + random.choice(EXTREMES).encode() + data[value.end() :]


class Fuzz:
    """Puts messages where they would arrive, and notes what comes of it.

    Attributes:
        told: How many were refused, or were valid as they stood, by where they went.
        faults: What should not have been.
    """

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)  # noqa: S311  nothing here is secret
        self.rig = CountingRig()
        self.attendant = RequestHandler(self.rig, MemoryLedger(), lambda: None)
        self.desk = MessageDispatcher(self.attendant, "0f", "0f")
        self.seeds = seeds()
        self.told: Counter[str] = Counter()
        self.faults: list[str] = []
        self._wanted: set[TrialRequest] = set()

    def turn(self, number: int) -> None:
        """Sends one changed message, and the valid one where that is a trial."""
        if number % 3:
            where, data = self.random.choice(self.seeds)
        else:
            request = replace(REQUEST, number=number, profile=self.random.choice(PROFILES))
            where = "@cmd/0f/submit"
            data = messages.encode(Submit(HELD, request, digest(request)))
        changed = mutated(self.random, data, self.seeds)
        if where.startswith("decode/"):
            self._decode(where.removeprefix("decode/"), data, changed)
            return
        self._command("@cmd/0f/lease", messages.encode(Lease("acquire", HELD, "fuzz")))
        self._command(where, changed)
        if where.endswith("submit"):
            self._wanted.add(request)
            self._command(where, data)
        self._command("@cmd/0f/clear", messages.encode(Clear()))

    def finish(self) -> None:
        """Looks whether the rig has run what it was asked to, and nothing else."""
        self.attendant.close()
        asked = self.rig.asked
        if len(set(asked)) != len(asked):
            self.faults.append("a trial ran twice")
        if strangers := [r.trial_id for r in asked if r not in self._wanted]:
            self.faults.append(f"trials ran that nobody had asked for: {strangers[:3]}")

    def _command(self, where: str, data: bytes) -> None:
        answers: list[bytes] = []
        self.desk.answer(where.split("/"), data, answers.append)
        what = where.rsplit("/", maxsplit=1)[-1] if where.startswith("@") else "inquire"
        if len(answers) != 1:
            self.faults.append(f"{len(answers)} answers to {where} {data!r}")
            return
        try:
            found = messages.decode_trial(answers[0])
        except EstuneError as error:
            self.faults.append(f"the answer to {where} {data!r} cannot be understood: {error}")
            return
        if isinstance(found, Answer) and "the rig's own program failed" in found.sentence:
            self.faults.append(f"{where} {data!r} broke the rig's program: {found.sentence}")
        refused = isinstance(found, Answer) and found.error == "ProtocolError"
        self.told[f"{what}, {'refused' if refused else 'understood'}"] += 1

    def _decode(self, what: str, original: bytes, data: bytes) -> None:
        kinds = {"Answer": Answer, "Status": Status, "Description": Description}
        try:
            if what in kinds:
                message: object = messages.decode(kinds[what], data)
                if messages.decode(kinds[what], messages.encode(message)) != message:
                    self.faults.append(f"{what} {data!r} changes when it is sent on")
            elif what == "live":
                messages.decode_live("fuzz", data)
            else:
                messages.decode_trial(data)
        except EstuneError:
            self.told[f"{what}, refused"] += 1
            return
        except Exception as error:  # noqa: BLE001  what this experiment looks for
            self.faults.append(f"{what} {data!r} raises {type(error).__name__}: {error}")
            return
        self.told[f"{what}, understood"] += 1
        if what in ("frame", "part", "live") and data != original:
            self.faults.append(f"a damaged {what} passes for a good one: {data!r}")


def fuzz(mutations: int, seed: int = 0) -> Fuzz:
    """Sends so many changed messages."""
    logging.disable()  # each stop, and each fault of a client, would be a line
    try:
        run = Fuzz(seed)
        for number in range(mutations):
            run.turn(number)
        run.finish()
    finally:
        logging.disable(logging.NOTSET)
    return run


def main() -> int:
    """Fuzzes, prints, and says by its exit code whether every target was met."""
    parser = command_line(__doc__, quick="some thousand messages only")
    parser.add_argument("--mutations", type=int, default=MUTATIONS, help="how many messages")
    parser.add_argument("--seed", type=int, default=0, help="of the changes")
    arguments = parser.parse_args()
    mutations = QUICK if arguments.quick else arguments.mutations
    run = fuzz(mutations, arguments.seed)
    figures = {"mutations": mutations, "trials_run": len(run.rig.asked), "faults": len(run.faults)}
    if not arguments.json:
        print(f"{mutations} changed messages; {len(run.rig.asked)} trials run\n")
        for what in sorted(run.told):
            print(f"  {run.told[what]:7}  {what}")
        print(f"\n{len(run.faults)} faults")
        for fault in run.faults[:10]:
            print(f"  {fault[:300]}")
    return tell(figures, {"faults": at_most(len(run.faults), 0)}, as_json=arguments.json)


if __name__ == "__main__":
    raise SystemExit(main())
