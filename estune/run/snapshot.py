"""Snapshots of a session, so that a long run resumes without a replay of all its trials.

A snapshot holds the session after the first `INTERVAL`, 2 `INTERVAL`, ... trials of a run. It is
used only by the same version of estune and on unchanged trials; else all trials are replayed.
"""

import hashlib
import io
import marshal
import pickle
from collections.abc import Sequence
from dataclasses import is_dataclass
from enum import Enum
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from estune.run.journal import Journal, JournalEntry, StoredSnapshot
from estune.run.plan import Plan
from estune.run.session import Session

INTERVAL = 500
"""Trials between snapshots. A run cut off while it writes one replays twice as many."""

_MODULES = (
    *("estune.core.", "estune.loop_model.", "estune.trial.", "estune.tuners."),
    "estune.run.phase",
    "estune.run.plan",
    "estune.run.session",
    "estune.run.tally",
)
"""Modules on which proposals depend; their values make up a session."""

_ARRAYS = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    *(
        (f"numpy.{core}.multiarray", f)
        for core in ("core", "_core")
        for f in ("_reconstruct", "scalar")
    ),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
}
"""Functions by which pickle makes arrays of numbers."""


def write_if_due(journal: Journal, session: Session, entries: Sequence[JournalEntry]) -> None:
    """Stores a snapshot of the session after these trials, if their number is a multiple."""
    if not entries or len(entries) % INTERVAL:
        return
    known = journal.snapshot()
    if known is None or known.trials >= len(entries) or known.version != code_version():
        digest = _digest(entries, "")
    else:
        digest = _digest(entries[known.trials :], known.digest)
    output = io.BytesIO()
    try:
        _Pickler(output, session.plan).dump(session)
        _Unpickler(io.BytesIO(output.getvalue()), session.plan).load()
    except (pickle.PickleError, TypeError, AttributeError):
        return  # a tuner of the user's own, whose state cannot be stored: its runs are replayed
    state = output.getvalue()
    journal.write_snapshot(StoredSnapshot(len(entries), code_version(), digest, state))


def read(
    journal: Journal, plan: Plan, entries: Sequence[JournalEntry]
) -> tuple[int, Session | None]:
    """The latest session of a snapshot, and the number of trials before it; (0, None) if none."""
    snapshot = journal.snapshot()
    if snapshot is None:
        return 0, None
    unusable = snapshot.version != code_version() or snapshot.trials > len(entries)
    # The trials of a journal that was changed are replayed, which finds the one that differs.
    if unusable or snapshot.digest != _digest(entries[: snapshot.trials], ""):
        return 0, None
    try:
        session = _Unpickler(io.BytesIO(snapshot.state), plan).load()
    except Exception:  # noqa: BLE001  pickle raises anything on damaged data
        return 0, None
    return (snapshot.trials, session) if isinstance(session, Session) else (0, None)


@cache
def code_version() -> str:
    """Digest of all code on which proposals depend."""
    digest = hashlib.sha256("".join(map(version, ("numpy", "scipy"))).encode())
    package = Path(__file__).parents[1]
    for module in _MODULES:
        path = package.joinpath(*module.split(".")[1:])
        files = sorted(path.rglob("*.py")) if module.endswith(".") else [path.with_suffix(".py")]
        for file in files:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _digest(entries: Sequence[JournalEntry], before: str) -> str:
    """Digest of trials in blocks of `INTERVAL`, after a digest of those before."""
    for begin in range(0, len(entries), INTERVAL):
        block = [
            (e.trial_id, str(e.phase), e.gain_values, str(e.outcome), e.cost, e.margin)
            for e in entries[begin : begin + INTERVAL]
        ]
        # Format 2 of marshal depends on the values alone, and is the fastest there is.
        before = hashlib.sha256(before.encode() + marshal.dumps(block, 2)).hexdigest()
    return before


class _Pickler(pickle.Pickler):
    """Pickles a session without its plan, which the run stores."""

    def __init__(self, file: io.BytesIO, plan: Plan) -> None:
        super().__init__(file, protocol=5)
        self._plan = plan

    def persistent_id(self, obj: Any) -> str | None:
        return "plan" if obj is self._plan else None


class _Unpickler(pickle.Unpickler):
    """Makes values of the session and of the tuner's own package, and arrays; nothing else."""

    def __init__(self, file: io.BytesIO, plan: Plan) -> None:
        super().__init__(file)
        self._plan = plan
        own = type(plan.tuner).__module__.partition(".")[0]
        self._modules = _MODULES if own == "estune" else (*_MODULES, own)

    def persistent_load(self, _: Any) -> Plan:
        return self._plan

    def find_class(self, module: str, name: str) -> Any:
        """A class of values; a journal from elsewhere must not call anything."""
        if (module, name) in _ARRAYS:
            return super().find_class(module, name)
        if module.startswith(self._modules):
            found = super().find_class(module, name)
            if isinstance(found, type) and (
                is_dataclass(found) or issubclass(found, tuple | Enum)
            ):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is not part of a snapshot")
