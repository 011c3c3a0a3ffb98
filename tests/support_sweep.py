"""A model that can be made to fail at one length, for tests of sweeps."""

from tests.support_rigs import ScriptedRig, broken, response

broken_at_m: set[float] = set()
"""Lengths at which the next trials fail."""


class Fragile:
    """A plant whose rig fails at some lengths."""

    def __init__(self, cable_length_m: float) -> None:
        self._length_m = cable_length_m

    def rig(self, seed: int) -> ScriptedRig:  # noqa: ARG002  as a plant's is called
        answer = broken if self._length_m in broken_at_m else response
        return ScriptedRig(answer, cable_length_m=self._length_m)


def fragile(cable_length_m: float) -> Fragile:
    """Plant at one length."""
    return Fragile(cable_length_m)
