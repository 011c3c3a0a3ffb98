"""Setpoint profiles of trials: a step for tuning, excitations for identification.

A profile is a few numbers and a formula, so that a request stays small and a small board can
compute the setpoint itself. In all formulas k is the sample from 0, f_s the sampling rate,
t = k/f_s and s = t - start_s; before `start_s` the setpoint is the preload.

In a closed loop the setpoint is followed by the controller. In an open loop it goes straight to
the current loop: current = setpoint / newtons per ampere, within the rig's limits of effort.
"""

from typing import Annotated, Any, Literal, TypeAlias

from estune.trial.profiles.excitations import ChirpProfile, StaircaseProfile, TriangleProfile
from estune.trial.profiles.load_step import LoadStepProfile
from estune.trial.profiles.multisine import MOST_LINES, Lines, MultisineProfile
from estune.trial.profiles.sampled import Loop
from estune.trial.profiles.step import StepProfile

__all__ = [
    "MOST_LINES",
    "AnyProfile",
    "ChirpProfile",
    "Kind",
    "Lines",
    "LoadStepProfile",
    "Loop",
    "MultisineProfile",
    "Profile",
    "StaircaseProfile",
    "StepProfile",
    "TriangleProfile",
]

Kind = Literal["step", "load_step", "triangle", "multisine", "chirp", "staircase"]


class _ByKind:
    """Makes pydantic discriminate profiles by `kind`, without an import of pydantic here."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic import Field  # noqa: PLC0415  slow to import, not needed by every command

        return handler(Annotated[source, Field(discriminator="kind")])


AnyProfile: TypeAlias = (
    StepProfile
    | LoadStepProfile
    | TriangleProfile
    | MultisineProfile
    | ChirpProfile
    | StaircaseProfile
)
Profile: TypeAlias = Annotated[AnyProfile, _ByKind()]
"""Any profile."""
