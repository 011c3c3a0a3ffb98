"""The result of a run as its page shows it, with what making its gains live would change."""

from dataclasses import dataclass
from typing import Any

from estune.core.gains import GAIN_NAMES, Gains
from estune.loop_model.intervals import Interval
from estune.loop_model.optimum import RobustnessLimits
from estune.run.results.result import TuneResult
from estune.run.results.summary import share_text
from estune.web.board import Board
from estune.web.predicted import PredictedResponse, by_identified_loop


def shown_result(result: TuneResult) -> dict[str, Any]:
    """Heading, table and remarks of a result, and its gains as they are offered."""
    return {
        "heading": result.heading(),
        "good": result.ending.good,
        "ending": result.ending,
        "tuned": result.success,
        "rows": [list(row) for row in result.rows()],
        "remarks": list(result.remarks()),
        "offer": _offer(result),
    }


def _offer(result: TuneResult) -> dict[str, Any] | None:
    """The tuned gains to be made live, or why they are not offered; None without tuned gains."""
    if not result.ending.is_tuned:
        return None
    limits = result.limits
    reason = limits.reason if limits is not None else ""
    if not result.ending.is_offered:
        return {"refused": f"Not offered to be made live: {reason}."}
    margins = result.claim.margins
    predicted = "-" if margins is None else _percent(margins.overshoot)
    rows = [list(row) for row in result.rows() if row.label in _COMPARED]
    rows.insert(_COMPARED.index("overshoot") + 1, ["overshoot (predicted)", "-", predicted])
    kept = f"Not shown to be kept: {reason}." if reason else "All are kept."
    return {
        "refused": "",
        "gains": dict(zip(GAIN_NAMES, result.gains.as_tuple(), strict=True)),
        "rows": rows,
        "limits": f"{limits_text(result.plan.limits)} {kept}" if result.plan.limits else "",
    }


_COMPARED = (
    *("cost η", "rise time", "settling time (2 %)", "overshoot"),
    *("sensitivity Ms (records)", "phase margin (records)"),
)
"""Rows of the result that stand beside the gains; they are there in every result."""


def limits_text(limits: RobustnessLimits) -> str:
    """The limits in a sentence."""
    Ms, overshoot, margin = (
        limits.max_sensitivity,
        limits.max_overshoot,
        limits.min_phase_margin_deg,
    )
    parts = [f"Ms at most {Ms:g}"] if Ms is not None else []
    parts += [f"overshoot at most {share_text(overshoot)}"] if overshoot is not None else []
    parts += [f"phase margin at least {margin:g}°"] if margin is not None else []
    return f"Limits: {', '.join(parts) or 'none'}."


def _percent(at: Interval) -> str:
    low, high = share_text(at.low), share_text(at.high)
    return share_text(at.value) if low == high else f"{share_text(at.value)} ({low} to {high})"


@dataclass
class LivePrediction:
    """The response that the loop of a run predicts for the live gains of the rig on a board."""

    board: Board
    result: TuneResult
    shown: "list[float] | None" = None

    def update(self) -> None:
        """Predicts again where the live gains have changed."""
        about = self.board.get("description")
        live = about and about["gains"]
        if live == self.shown or self.result.identified.fit is None:
            return
        self.shown = live
        found: PredictedResponse | None = None
        if live is not None:
            source = f"the loop identified in run {self.result.plan.run}"
            found = by_identified_loop(self.result, Gains(*live), source)
        self.board.put("predicted.run", found and found.to_json())
