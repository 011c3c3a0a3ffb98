"""Tracking, rest and remedies of one rig in service: what the step of a check trial hides.

Beside each check, where the rig has proven remedies, a pair of turns without one and with it;
else, where it is asked for, one turn at the live gains. What a remedy does in a trial is part of
the request, so that the rig is as it was whenever a trial ends, by whatever end. A remedy that has
lost its gain is switched off at the rig, and never on.
"""

import time
from typing import Any

import numpy as np

from estune.daemon.check_trials import check_cut_off
from estune.daemon.config import RigTable
from estune.daemon.store import DaemonStore, age_s, now
from estune.errors import InvalidInput
from estune.proof.patch import Patch, read_proven
from estune.proof.service import Gain, gain_of
from estune.proof.trials import MEASURES, EndedEarly, Stop, measured, measured_pair
from estune.run.behaviour import LoopBehaviour
from estune.trial import CompensatedRig, Rig, RigDescription

PAIRS_KEPT = 100
"""Newest pairs of a remedy that are kept."""
_TRIALS = 4
"""Trials of a pair; each has a number of its own."""


class BehaviourChecks:
    """Tracking, rest and remedies of one rig.

    Attributes:
        behaviour: Tracking and rest at the live gains as last measured; None before.
        said: What is known of each remedy, in words, by the name of its patch.
    """

    def __init__(self, store: DaemonStore, settings: RigTable) -> None:
        """Reads the patches.

        Raises:
            InvalidInput: a file is no patch, or its remedy is not proven.
        """
        self.behaviour: LoopBehaviour | None = None
        self.said: dict[str, str] = {}
        self._store, self._watch = store, settings.watch
        self._remedies = [read_proven(path) for path in settings.remedies]
        self._due_s: float | None = None
        self._turn = 0

    @property
    def status(self) -> dict[str, Any]:
        """Its part of the daemon's status."""
        return {
            "behaviour": self.behaviour and tuple(self.behaviour),
            "remedies": dict(self.said),
        }

    @property
    def wait_s(self) -> float:
        """Time until the next turn; infinite where nothing is measured."""
        if not self._remedies and not self._watch.tracking:
            return np.inf
        if self._due_s is None:
            # The time of day, which may jump, counts once; later the process's own clock does.
            last, every_s = self._store.fact("behaviour_at"), self._watch.every_s
            left_s = 0.0 if last is None else every_s - age_s(last)
            self._due_s = time.monotonic() + min(every_s, max(0.0, left_s))
        return max(0.0, self._due_s - time.monotonic())

    def enforce(self, rig: Rig, description: RigDescription) -> str:
        """Switches off what was switched off before, after a restart of the rig; what, in words.

        Raises:
            RigError: the rig cannot be reached.
        """
        off = [
            remedy
            for remedy in self._remedies
            if self._stored(remedy)["off"] and remedy.is_on(description.compensation)
        ]
        for patch in off:
            _switch_off(rig, patch)
        return ", ".join(patch.effect for patch in off)

    def take(self, rig: Rig, description: RigDescription) -> list[tuple[str, str]]:
        """Runs the next turn or pair; remedies switched off by it, each with the reason.

        Raises:
            RigError: the rig cannot be reached.
            Interrupted: a trial was cut off on a real rig.
            JournalError: the result cannot be stored; the same trials are requested again.
        """
        watched, number = self._next(description), self._store.fact("behaviour_trials") or 0
        place = f"{self._store.identity}-behaviour", number
        # After a loss of the rig, or a restart, the same is asked again: no trial runs twice.
        reports: list[tuple[str, str]] = []
        suspect = False
        try:
            if watched is None:
                self._note(measured(rig, description, place))
            else:
                suspect, reports = self._pair(rig, description, place, watched)
        except EndedEarly as error:
            self._store.set_fact("behaviour_trials", number + _TRIALS)
            check_cut_off(error.record, description)
            if error.record.outcome.is_void:
                return []
            self.said["behaviour"] = str(error)
        except InvalidInput as error:  # the rig's limits do not allow a trial
            self.said["behaviour"] = f"cannot be measured: {error}"
        self._turn += not suspect
        more = self._turn % max(len(self._remedies), 1)
        self._due_s = time.monotonic() + (0.0 if suspect or more else self._watch.every_s)
        with self._store.transaction():
            self._store.set_fact("behaviour_trials", number + _TRIALS)
            self._store.set_fact("behaviour_at", now())
        return reports

    def _next(self, description: RigDescription) -> Patch | None:
        """The remedy whose turn it is; None where it is not on, which is said."""
        if not self._remedies:
            return None
        remedy = self._remedies[self._turn % len(self._remedies)]
        effect, stored = remedy.effect, self._stored(remedy)
        if stored["off"]:
            self.said[effect] = f"switched off: {stored['off']}"
        elif not remedy.is_on(description.compensation):
            self.said[effect] = "not watched: the rig's own compensations do not have its numbers"
        else:
            return remedy
        return None

    def _pair(
        self, rig: Rig, about: RigDescription, place: tuple[str, int], remedy: Patch
    ) -> tuple[bool, list[tuple[str, str]]]:
        """A pair: whether it is to be repeated at once, and what is to be reported."""
        proof, stored = remedy.proof or {}, self._stored(remedy)
        try:
            off, on = measured_pair(rig, about, place, remedy)
        except Stop as stop:
            return False, self._lost(rig, remedy, stored, str(stop))
        self._note(on)
        ratios = (on / off).tolist()
        row = [*stored["row"], ratios]
        state = gain_of(row, proof, self._watch.false_alarm_checks, self._watch.scatter_min)
        words = ", ".join(
            f"{name} {ratio:.2f} (proof {proof['ratios'][name]['value']:.2f})"
            for name, ratio in zip(MEASURES, ratios, strict=True)
        )
        self.said[remedy.effect] = f"{state}: ratio to without: {words}"
        stored["row"] = [] if state is Gain.KEPT else row
        stored["pairs"] = [*stored["pairs"], [now(), *ratios]][-PAIRS_KEPT:]
        if state is Gain.LOST:
            why = f"it has lost its gain in {len(row)} pairs; {words}"
            return False, self._lost(rig, remedy, stored, why)
        self._keep(remedy, stored)
        return state is Gain.SUSPECT, []

    def _lost(
        self, rig: Rig, remedy: Patch, stored: dict[str, Any], why: str
    ) -> list[tuple[str, str]]:
        """Stores that it is off, then switches it off: after a crash between, `enforce` does."""
        self._keep(remedy, stored | {"off": why, "row": []})
        self.said[remedy.effect] = f"switched off: {why}"
        _switch_off(rig, remedy)
        return [(remedy.effect, why)]

    def _note(self, values: Any) -> None:
        self.behaviour = LoopBehaviour(*map(float, values[1:]))

    def _stored(self, remedy: Patch) -> dict[str, Any]:
        empty = {"off": "", "row": [], "pairs": []}
        return {**empty, **(self._store.fact("remedies") or {}).get(_key(remedy), {})}

    def _keep(self, remedy: Patch, stored: dict[str, Any]) -> None:
        everything = self._store.fact("remedies") or {}
        self._store.set_fact("remedies", {**everything, _key(remedy): stored})


def _key(remedy: Patch) -> str:
    return f"{remedy.effect} {(remedy.proof or {})['date']}"


def _switch_off(rig: Rig, patch: Patch) -> None:
    assert isinstance(rig, CompensatedRig)  # noqa: S101  as `RigAccess` is
    rig.switch_off(tuple(patch.tables))
