"""What is usually written first: ask by a plain get, and ask again where no answer came.

The same tuning as the project's own, its state kept as lines of a text file, one per trial told.
"""

import json
import math
import time
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import zenoh

from estune.core.gains import Gains
from estune.errors import ProtocolError
from estune.remote.zenoh.zenoh_session import open_session
from estune.run.plan import make_plan
from estune.run.session import Session, after_trial, new_session, next_request
from estune.trial import Outcome, RigDescription, TrialRecord, TrialRequest, record_frame
from estune.trial.scoring import cost_of
from experiments.chaos.mischief import Message, Mischief
from experiments.chaos.rig import PLAIN_KEY, as_served, truth

ANSWER_WITHIN_S = 2.0
AGAIN_S = 0.1


class Errand(Protocol):
    """What the plain client has to know of its errand."""

    rig: str
    run: str
    tuner: str
    start: tuple[float, float, float, float]
    trials: int


class Told(NamedTuple):
    """One trial told, as it is kept."""

    number: int
    gains: tuple[float, ...]
    outcome: str
    cost: float


def plan_of(errand: Any, description: RigDescription) -> Any:
    """The plan both kinds of client follow."""
    return make_plan(
        *(description, errand.run),
        tuner=errand.tuner,
        start=Gains(*errand.start),
        bounds=None,
        step=None,
        cost=None,
        trials=errand.trials,
    )


def read(path: Path) -> list[Told]:
    """What was told so far. A line that was cut short is left out."""
    if not path.exists():
        return []
    made = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            made.append(Told(*json.loads(line)))
        except (ValueError, TypeError):
            continue
    return made


def tune_plainly(endpoint: str, folder: Path, errand: Any, mischief: Mischief) -> None:
    """Runs the trials that are still missing."""
    folder.mkdir(parents=True, exist_ok=True)
    book = folder / "trials.jsonl"
    description = as_served(truth(errand.rig)).describe()
    session = new_session(plan_of(errand, description))
    for entry in read(book):
        session = after_trial(session, Outcome(entry.outcome), entry.cost)
    with _connected(endpoint) as link:
        while (request := next_request(session)) is not None:
            record = _ask(link, request, mischief)
            session, entry = _scored(session, request, record, description)
            with book.open("a", encoding="utf-8") as file:
                file.write(f"{json.dumps(entry)}\n")
            (folder / f"{request.trial_id}.frame").write_bytes(record_frame.encode(record))


def _scored(
    session: Session, request: TrialRequest, record: TrialRecord, description: RigDescription
) -> tuple[Session, Told]:
    plan = session.plan
    cost = cost_of(record, plan.step, plan.cost, description.newtons_per_ampere)
    entry = Told(request.number, request.gains.as_tuple(), record.outcome.value, cost)
    return after_trial(session, record.outcome, cost if math.isfinite(cost) else math.nan), entry


def _connected(endpoint: str) -> zenoh.Session:
    while True:
        try:
            return open_session("client", connect=(endpoint,), message_max_bytes=2**24)
        except zenoh.ZError:
            time.sleep(AGAIN_S)


def _ask(link: zenoh.Session, request: TrialRequest, mischief: Mischief) -> TrialRecord:
    asked = {"run": request.run, "number": request.number, "gains": request.gains.as_tuple()}
    payload = json.dumps(asked).encode()
    while True:
        if not mischief.is_held_back(Message(PLAIN_KEY, payload), submit=True):
            for reply in link.get(PLAIN_KEY, payload=payload, timeout=ANSWER_WITHIN_S):
                if reply.ok is not None:
                    try:
                        return record_frame.decode(reply.ok.payload.to_bytes())
                    except ProtocolError:
                        continue
        time.sleep(AGAIN_S)
