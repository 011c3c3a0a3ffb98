"""The proof of a remedy: trials without it, with it, with it, without it, at the same gains.

Each time a step with the rest after it, then a slow triangle. The remedy is part of the request of
a trial, so that it is on while that trial runs and never longer: a proof that is killed leaves the
rig as it was.
"""

import uuid
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, RigError
from estune.proof.patch import Patch
from estune.run.behaviour import rest_in, step_cost_in, tracking_in
from estune.run.failed_trials import FailureMemory, run_trial
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest
from estune.trial.tracking import WIDE, resting_profile, tracking_profile

MEASURES = ("cost", "tracking", "reversal", "rest")
NOUNS = {
    "cost": "cost",
    "tracking": "slow tracking error",
    "reversal": "error at reversals",
    "rest": "restlessness",
}
RESTLESS = 1.5
"""Ratio of the deviation at rest from which a remedy is switched off at once. A second of rest
repeats to 10 %; a friction fed forward along the measured velocity hunted at 6 to 15 times."""
GAIN = 0.02
"""Least gain that is a gain; and greatest loss of another measure."""
UNCHANGED = 0.1
"""Greatest half of an interval about one that is called unchanged."""
CONFIDENCE = 0.95


class RemedyRig:
    """A rig whose every trial has a remedy on; implements `estune.trial.Rig`."""

    def __init__(self, rig: Rig, patch: Patch) -> None:
        own = rig.describe().compensation
        self._rig, self._compensation = rig, patch.compensation(own, on=True)

    def describe(self) -> RigDescription:
        """Description of the rig."""
        return self._rig.describe()

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial with the remedy on."""
        return self._rig.run(self._with_remedy(request))

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones."""
        self._rig.apply(gains)

    def abort(self) -> RigDescription:
        """Stops the trial under way."""
        return self._rig.abort()

    def estop(self, reason: str) -> None:
        """Begins to bring the rig to its safe state."""
        self._rig.estop(reason)

    def clear(self) -> None:
        """Resets the emergency stop."""
        self._rig.clear()

    def has_failed(self, request: TrialRequest) -> bool:
        """Whether no record can ever be had under a trial's id."""
        if not isinstance(self._rig, FailureMemory):
            return False
        # Without the remedy it would be another trial under the id, of which no record is had.
        return self._rig.has_failed(self._with_remedy(request))

    def close(self) -> None:
        """Leaves the rig to its owner."""

    def _with_remedy(self, request: TrialRequest) -> TrialRequest:
        return replace(request, compensation=self._compensation)


class MeasuredRatio(NamedTuple):
    """A measured ratio of with to without, and its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Proof:
    """What a rig showed of a remedy.

    Attributes:
        date: Date of the proof, ISO 8601.
        pairs: Pairs of trials with it and without.
        stopped: Why it was stopped and switched off; empty where it was not.
        tuned: Cost with the remedy on before and after a tuning; None without one.
    """

    rig: str
    date: str
    gains: Gains
    pairs: int
    ratios: Mapping[str, MeasuredRatio]
    stopped: str = ""
    tuned: tuple[float, float] | None = None

    @property
    def proven(self) -> bool:
        """Whether a measure is better by more than its interval, and none worse."""
        if self.stopped:
            return False
        gained = any(self.ratios[name].high < 1.0 - GAIN for name in MEASURES[:3])
        return gained and not any(ratio.low > 1.0 + GAIN for ratio in self.ratios.values())

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        if self.stopped:
            return f"stopped and switched off: {self.stopped}"
        parts = []
        for name, ratio in self.ratios.items():
            told = f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}] of what it was"
            if not ratio.low <= 1.0 <= ratio.high:
                parts.append(f"{NOUNS[name]} {told}")
            elif max(ratio.high - 1.0, 1.0 - ratio.low) <= UNCHANGED:
                parts.append(f"{NOUNS[name]} unchanged")
            else:
                parts.append(f"{NOUNS[name]} undecided, {told}")
        if self.tuned is not None:
            before, after = self.tuned
            parts.append(f"tuned with it on, the cost falls from {before:.3g} to {after:.3g}")
        return "; ".join(parts)

    def to_json(self) -> dict[str, Any]:
        """The proof as JSON values, with its sentence and whether it is proven."""
        ratios = {name: ratio._asdict() for name, ratio in self.ratios.items()}
        told = {"proven": self.proven, "sentence": self.sentence}
        return {**asdict(self), "ratios": ratios, **told}


class Stop(Exception):
    """The remedy has to be switched off."""


class EndedEarly(RigError):
    """A trial that says nothing of the remedy has ended early."""

    def __init__(self, message: str, record: TrialRecord) -> None:
        super().__init__(message)
        self.record = record


def prove(
    rig: Rig,
    patch: Patch,
    *,
    pairs: int = 2,
    say: Callable[[str], None] = lambda _: None,
) -> Proof:
    """Runs the trials of a proof at the rig's live gains.

    Args:
        pairs: Pairs of trials with it and without; even.
        say: Told of each trial before it begins.

    Raises:
        InvalidInput: the number of pairs is odd, or the rig's limits do not allow the trials.
        RigError: the rig cannot run a trial without the remedy, or does not run the remedy.
    """
    if pairs < 2 or pairs % 2:
        raise InvalidInput(f"pairs is {pairs}; give an even number, 2 or above")
    about = rig.describe()
    run = f"prove-{uuid.uuid4().hex[:12]}"
    found: dict[bool, list[FloatArray]] = {True: [], False: []}
    stopped = ""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        for number, on in enumerate((False, True, True, False) * (pairs // 2)):
            say(f"{'with' if on else 'without'} the remedy, {number + 1} of {2 * pairs}")
            calm = float(found[False][0][-1]) if on else None
            found[on].append(measured(rig, about, (run, 2 * number), patch, calm))
    except Stop as stop:
        stopped = str(stop)
    ratios = {} if stopped else _ratios(np.array(found[True]), np.array(found[False]))
    return Proof(about.name, date, about.gains, pairs, ratios, stopped)


def measured_pair(
    rig: Rig, about: RigDescription, place: tuple[str, int], patch: Patch
) -> tuple[FloatArray, FloatArray]:
    """One pair of turns, without a remedy and then with it; see `measured`.

    Raises:
        Stop, RigError, InvalidInput: see `measured`.
    """
    run, number = place
    off = measured(rig, about, place, patch)
    return off, measured(rig, about, (run, number + 2), patch, float(off[-1]))


def measured(
    rig: Rig,
    about: RigDescription,
    place: tuple[str, int],
    patch: Patch | None = None,
    calm: float | None = None,
) -> FloatArray:
    """`MEASURES` of one turn: a step with rest, and a triangle; both trials at the live gains.

    Args:
        place: Run and number of the first trial.
        patch: The remedy; None leaves the rig's compensations as they are.
        calm: Deviation at rest without the remedy; None runs the turn without it.

    Raises:
        Stop: with the remedy on the rig was restless, or a trial did not end well.
        EndedEarly: a trial without it did not end well, or one was void.
        RigError: the rig cannot be reached, or ignores the remedy.
        InvalidInput: the rig's limits do not allow a trial.
    """
    settling, on = about.settling_time_s, calm is not None
    text = patch.compensation(about.compensation, on=on) if patch else ""
    wide = about.limits if patch and WIDE & set(patch.tables) else None
    triangle = tracking_profile(about.step, settling, wide)
    run, number = place
    step = resting_profile(about.step, settling)
    about.limits.check_each(step, triangle)  # before the first motion
    resting = TrialRequest(run, number, about.gains, step, compensation=text)
    record = _trial(rig, about, resting, on=on)
    rest = rest_in(record, about)
    if calm is not None and not rest <= RESTLESS * calm:
        now, before = about.measured(rest, 3), about.measured(calm, 3)
        raise Stop(f"at rest the measurement deviates by {now}, without it by {before}")
    slow = replace(resting, number=number + 1, profile=triangle)
    followed = _trial(rig, about, slow, on=on)
    if patch and "eyelet" in patch.tables:
        record, followed = _outside(record), _outside(followed)
    tracked = tracking_in(followed, about, triangle)
    return np.array([step_cost_in(record, about), *tracked, rest])


def _outside(record: TrialRecord) -> TrialRecord:
    """The record with the tension outside the eyelet, which its own gauge does not read."""
    if record.reference_N is None:
        raise InvalidInput(
            f"rig {record.rig} has no gauge outside its eyelet (reference_N), so that what the "
            "remedy does to the tension there cannot be measured; add one for the proof"
        )
    return replace(record, tension_N=record.reference_N, notch_N=None)


def _trial(rig: Rig, about: RigDescription, request: TrialRequest, *, on: bool) -> TrialRecord:
    try:
        record = run_trial(rig, request, about)
    except RigError as error:
        if not on or isinstance(rig, FailureMemory):  # that it is lost says nothing of the remedy
            raise
        raise Stop(f"the rig took no trial with it: {error}") from error
    if record.outcome is not Outcome.DONE:
        why = record.reason or record.outcome.sentence
        if on and not record.outcome.is_void:
            raise Stop(f"a trial with it ended early: {why}")
        if on and isinstance(rig, FailureMemory) and rig.has_failed(request):
            raise Stop(f"the rig took no trial with it: {why}")
        raise EndedEarly(
            f"trial {record.trial_id} ended early: {why}; check the rig, then prove anew", record
        )
    if on and not any(column.any() for column in record.optional_columns.values()):
        raise RigError(
            f"rig {about.name} ran the trial without the remedy: it does not know compensations "
            "of a trial; apply the patch to its file, and compare runs made before and after"
        )
    return record


def _ratios(on: FloatArray, off: FloatArray) -> dict[str, MeasuredRatio]:
    """Geometric means of with over without; intervals from the scatter of the repeats."""
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    ons, offs = np.log(on), np.log(off)
    repeats = len(ons)
    variance = 0.5 * (ons.var(axis=0, ddof=1) + offs.var(axis=0, ddof=1))
    middle = ons.mean(axis=0) - offs.mean(axis=0)
    wide = float(stdtrit(2 * repeats - 2, 0.5 + 0.5 * CONFIDENCE))
    half = wide * np.sqrt(2.0 * variance / repeats)
    columns = np.exp([middle, middle - half, middle + half]).T
    return {
        name: MeasuredRatio(*map(float, row)) for name, row in zip(MEASURES, columns, strict=True)
    }
