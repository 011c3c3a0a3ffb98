"""Several reels, each at a length of its own, as one rig that tries them in turn."""

from collections.abc import Sequence
from dataclasses import replace

from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.trial import Rig, RigDescription, RigLimits, TrialRecord, TrialRequest


class AlternatingReels:
    """Runs trial n on reel n mod m; implements `estune.trial.Rig`, but for `apply`.

    The reels must be of one kind: what differs between them is the length.
    """

    def __init__(self, rigs: Sequence[Rig]) -> None:
        """Takes the rigs in the order of the trials; they are closed by whoever opened them.

        Raises:
            InvalidInput: the rigs differ in more than their length.
        """
        self._rigs = tuple(rigs)
        abouts = [rig.describe() for rig in self._rigs]
        for name in ("newtons_per_ampere", "controller"):
            values = [getattr(about, name) for about in abouts]
            if any(value != values[0] for value in values):
                raise InvalidInput(
                    f"the reels of one schedule differ in {name} ({values}); give reels that "
                    "differ in their length only"
                )

    def describe(self) -> RigDescription:
        """The reels together: the first one's gains and step, and limits that all keep."""
        abouts = [rig.describe() for rig in self._rigs]
        limits = RigLimits(
            max(about.limits.tension_min_N for about in abouts),
            min(about.limits.tension_max_N for about in abouts),
            min(about.limits.duration_max_s for about in abouts),
        )
        return replace(
            abouts[0],
            name="+".join(about.name for about in abouts),
            limits=limits,
            settling_time_s=max(about.settling_time_s for about in abouts),
            cable_length_m=None,
            linear_model=None,
            simulated=all(about.simulated for about in abouts),
        )

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs the trial on the reel whose turn it is.

        Raises:
            InvalidInput: the request is outside that reel's limits; nothing moved.
            RigError: that reel cannot be reached, or knows another trial by that id.
        """
        return self._rigs[request.number % len(self._rigs)].run(request)

    def apply(self, gains: Gains) -> None:
        """Refused: reels of different lengths have a schedule and not one set of gains.

        Raises:
            RigError: always.
        """
        raise RigError(
            f"{gains} are for one length; apply the schedule's gains to each reel at its own"
        )

    def abort(self) -> RigDescription:
        """Stops the trial under way, if any, and returns once the live gains are back."""
        for rig in self._rigs:
            rig.abort()
        return self.describe()

    def estop(self, reason: str) -> None:
        """Brings every reel to its safe state."""
        for rig in self._rigs:
            rig.estop(reason)

    def clear(self) -> None:
        """Ends the emergency stop of every reel."""
        for rig in self._rigs:
            rig.clear()

    def close(self) -> None:
        """Lets go of every reel."""
        for rig in self._rigs:
            rig.close()
