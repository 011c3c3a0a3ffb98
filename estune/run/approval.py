"""The operator's approval of gains outside the region shown to be safe."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from estune.run.session import Session, predict_next
from estune.trial import TrialRequest
from estune.tuners.interface import CostPrediction


class ApprovalRequest(NamedTuple):
    """Request to the operator to approve a trial.

    Attributes:
        request: The trial that would be run.
        eta_max: The cost above which it is unsafe.
    """

    request: TrialRequest
    prediction: CostPrediction
    eta_max: float


Answer = Literal["yes", "no", "always"]
"""`always` approves this and all later requests of the run."""

ApprovalCallback = Callable[[ApprovalRequest], Answer]
"""Callback for the operator's approval; may block."""


def approval_request(session: Session, request: TrialRequest) -> ApprovalRequest | None:
    """Approval that the next trial needs; None if it needs none."""
    prediction = predict_next(session) if session.plan.ask_first else None
    if prediction is None or prediction.explored:
        return None
    return ApprovalRequest(request, prediction, session.eta_max)
