"""Which trials a rig has taken in, and what came of them."""

from collections import deque
from dataclasses import dataclass

from estune.errors import RigError
from estune.protocol import Answer, refusal

FRAMES_MAX_BYTES = 8 * 2**20
TRIALS_MAX = 100_000


@dataclass(slots=True)
class _Entry:
    digest: str
    state: Answer | bytes


class Ledger:
    """The trials of this instance by id and digest, so that none runs twice.

    The records of the oldest are let go first, once `frames_max_bytes` are held; that they have
    run is remembered longer, for the last `trials_max`.
    """

    def __init__(
        self, frames_max_bytes: int = FRAMES_MAX_BYTES, trials_max: int = TRIALS_MAX
    ) -> None:
        self._frames_max_bytes = frames_max_bytes
        self._trials_max = trials_max
        self._entries: dict[str, _Entry] = {}
        self._framed: deque[str] = deque()
        self._frame_bytes = 0

    def find(self, trial_id: str, digest: str) -> Answer | bytes | None:
        """The state of a trial: `known` until it has ended, then its frame or its refusal.

        None if it was never taken in; a refusal if another request was, under the same id.
        """
        entry = self._entries.get(trial_id)
        if entry is None:
            return None
        if entry.digest != digest:
            return refusal(
                RigError(
                    f"the rig knows another trial by the id {trial_id}, with other gains or "
                    "another step; give the run a new name"
                )
            )
        return entry.state

    def add(self, trial_id: str, digest: str) -> None:
        """Notes that a trial is taken in."""
        while len(self._entries) >= self._trials_max:
            # Only trials long ended: one is under way at a time, and it is the youngest.
            self._forget_record(oldest := next(iter(self._entries)))
            del self._entries[oldest]
        self._entries[trial_id] = _Entry(digest, Answer("known", trial_id))

    def end(self, trial_id: str, state: Answer | bytes) -> None:
        """Notes what came of a trial; its record, the youngest, is held in any case."""
        self._entries[trial_id].state = state
        if isinstance(state, bytes):
            self._framed.append(trial_id)
            self._frame_bytes += len(state)
        while self._frame_bytes > self._frames_max_bytes and len(self._framed) > 1:
            self._forget_record(self._framed[0])

    def _forget_record(self, trial_id: str) -> None:
        entry = self._entries[trial_id]
        if not isinstance(entry.state, bytes):
            return
        self._framed.remove(trial_id)  # always at or near the left end
        self._frame_bytes -= len(entry.state)
        entry.state = refusal(
            RigError(
                f"trial {trial_id} has run, but the rig no longer holds its record; "
                "ask for the trial again under another number or attempt"
            )
        )
