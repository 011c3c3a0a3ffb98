"""A client without the protocol: a plain get, repeated until a reply arrives.

It runs the same tuning as estune's client, its state kept in a text file, a line per trial.
"""

import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import zenoh

from estune.core.gains import Gains
from estune.errors import ProtocolError
from estune.remote.zenoh.zenoh_session import open_session
from estune.run.plan import Plan
from estune.run.planning import make_plan
from estune.run.session import after_trial, new_session, next_request
from estune.trial import Outcome, RigDescription, TrialRecord, TrialRequest, record_frame
from estune.trial.scoring import cost_of
from experiments.chaos.mischief import Message, Mischief
from experiments.chaos.motions import LoggedRig
from experiments.chaos.rig import PLAIN_KEY, reference_rig

ANSWER_WITHIN_S = 2.0
AGAIN_S = 0.1


@dataclass(frozen=True, slots=True)
class Errand:
    """Task of a client.

    Attributes:
        endpoint: Endpoint of its rig.
        rig: Name of the rig.
        folder: Folder of the runs.
        run: Name of the run.
        tuner: Name of the tuner.
        start: Initial gains.
        trials: Search trials.
        plain: Whether to use plain gets.
        seed: Seed of the mischief.
    """

    endpoint: str
    rig: str
    folder: str
    run: str
    tuner: str
    start: tuple[float, float, float, float]
    trials: int
    plain: bool = False
    seed: int = 0

    def dump(self) -> str:
        """The errand as one argument of a command."""
        return json.dumps(asdict(self))

    @property
    def journal(self) -> Path:
        """Folder of the run."""
        return Path(self.folder) / self.run

    def plan(self) -> tuple[RigDescription, Plan]:
        """The rig, and the plan that both kinds of client follow."""
        description = LoggedRig(reference_rig(self.rig)).describe()
        plan = make_plan(
            *(description, self.run),
            tuner=self.tuner,
            start=Gains(*self.start),
            bounds=None,
            step=None,
            cost=None,
            trials=self.trials,
        )
        return description, plan


class Line(NamedTuple):
    """One finished trial in the text file."""

    number: int
    gains: tuple[float, ...]
    outcome: str
    cost: float


def read(path: Path) -> list[Line]:
    """The finished trials, without lines that were cut short."""
    if not path.exists():
        return []
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines():
        try:
            lines.append(Line(*json.loads(text)))
        except (ValueError, TypeError):
            continue
    return lines


def tune_plainly(errand: Errand, mischief: Mischief) -> None:
    """Runs the trials that are still missing."""
    folder = errand.journal
    folder.mkdir(parents=True, exist_ok=True)
    book = folder / "trials.jsonl"
    description, plan = errand.plan()
    session = new_session(plan)
    for line in read(book):
        session = after_trial(session, Outcome(line.outcome), line.cost)
    with _connected(errand.endpoint) as link:
        while (request := next_request(session)) is not None:
            record = _run(link, request, mischief)
            cost = cost_of(record, plan.step, plan.cost, description.newtons_per_ampere)
            session = after_trial(
                session, record.outcome, cost if math.isfinite(cost) else math.nan
            )
            gains = request.gains.as_tuple()
            line = Line(request.number, gains, record.outcome.value, cost)
            with book.open("a", encoding="utf-8") as file:
                file.write(f"{json.dumps(line)}\n")
            (folder / f"{request.trial_id}.frame").write_bytes(record_frame.encode(record))


def _connected(endpoint: str) -> zenoh.Session:
    while True:
        try:
            return open_session("client", connect=(endpoint,), message_max_bytes=2**24)
        except zenoh.ZError:
            time.sleep(AGAIN_S)


def _run(link: zenoh.Session, request: TrialRequest, mischief: Mischief) -> TrialRecord:
    fields = {"run": request.run, "number": request.number, "gains": request.gains.as_tuple()}
    payload = json.dumps(fields).encode()
    while True:
        if not mischief.is_held_back(Message(PLAIN_KEY, payload), submit=True):
            for reply in link.get(PLAIN_KEY, payload=payload, timeout=ANSWER_WITHIN_S):
                if reply.ok is not None:
                    try:
                        return record_frame.decode(reply.ok.payload.to_bytes())
                    except ProtocolError:
                        continue
        time.sleep(AGAIN_S)
