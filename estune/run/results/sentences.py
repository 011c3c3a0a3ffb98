"""Sentences of a result: where it began, what it changed, what is claimed of it."""

from collections.abc import Iterable, Iterator

from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.loop_model.claim import Claim
from estune.loop_model.load_rejection import HORIZON, LoadRejection
from estune.run.limit_verdict import LimitVerdict
from estune.run.plan import Plan
from estune.run.results.result_warnings import ResultWarning
from estune.run.results.summary import Performance, rise_text, share_text
from estune.run.start import left_out
from estune.support.quantity_text import change_text, time_text
from estune.trial import RigDescription

BALANCED = "tracking_and_rejection"
"""The cost that weighs a setpoint step and a load step alike."""


def start_remarks(
    plan: Plan, start_gains: Gains, fitted_form: ControllerForm | None
) -> Iterator[str]:
    """Origin of initial gains that are not the rig's, and gains that were not tuned."""
    if plan.start_source:
        source = plan.start_source
        yield f"the search began at {source}, which are not live on the rig yet"
    if fitted_form is not None:
        yield (
            f"the logged effort is that of another form of the controller ({fitted_form}), "
            "by which the loop was identified; declare it as form in the rig's controller settings"
        )
    space = plan.tuner.space
    left = left_out(start_gains, space.names, plan.cost.settling_time_s)
    if left and space.form == "parallel":
        yield left


def response_changes(start: Performance, tuned: Performance | None) -> Iterator[str]:
    """Rise time and overshoot of the initial and of the tuned gains."""
    if tuned is not None and start.metrics is not None and tuned.metrics is not None:
        before, after = start.metrics, tuned.metrics
        yield f"rise {change_text(rise_text(before), rise_text(after))}"
        overshoots = share_text(before.overshoot), share_text(after.overshoot)
        yield f"overshoot {change_text(*overshoots)}"


def bounds_reached(findings: Iterable[ResultWarning]) -> Iterator[str]:
    """The bounds that ended the search, for without them the cost may be lower."""
    at = [name for finding in findings if finding.kind == "bound" for name in finding.parameters]
    if at:
        yield f"the search ended at its bounds of {' and '.join(at)}"


def claimed_robustness(claim: Claim, limits: LimitVerdict | None) -> str:
    """The claims about the tuned gains in a few words, and what stands against their limits."""
    margins = claim.margins
    if margins is None and (limits is None or claim.reason not in limits.reason):
        broken = [limits.reason] if limits is not None and limits.reason else []
        return " and ".join((*broken, f"no margins are claimed: {claim.reason}"))
    if margins is None or (limits is not None and limits.reason):
        return limits.reason if limits else ""
    return f"Ms {margins.sensitivity.value:.2f}, at most {margins.sensitivity.high:.2f}"


def load_cells(at: LoadRejection | None, rig: RigDescription) -> dict[str, str]:
    """Peak and end of the response to a load step as text, by label."""
    peak, gone = "peak after a load step (predicted)", "load rejected (2 %, predicted)"
    if at is None:
        return {peak: "-", gone: "-"}
    return {
        peak: rig.measured(at.peak, 3),
        gone: time_text(at.vanished_s) if at.vanishes else "never",
    }


def trial_remark(plan: Plan, rig: RigDescription) -> str:
    """The conditions of the trials; without them nobody can check the Ms of a result."""
    step, settings = plan.step, rig.controller
    reached = rig.measured(step.preload_N + step.step_N)
    lag_s = settings.derivative_filter_s
    filtered = f"filtered by {time_text(lag_s)}" if lag_s else "not filtered"
    return (
        f"trials step from {step.preload_N:g} to {reached}, the controller runs at "
        f"{settings.sampling_Hz:.4g} Hz, the derivative is {filtered}, and the cost asks "
        f"for settling in {time_text(plan.cost.settling_time_s)}"
    )


def load_remarks(at: LoadRejection | None, plan: Plan, rig: RigDescription) -> Iterator[str]:
    """The load step of the predictions, and what to do where it stays."""
    if at is None:
        return
    load = rig.commanded(float(f"{abs(at.load):.3g}"))
    yield f"the predicted load step is {load} at the plant's input, where no limit acts"
    for stays in load_stays(at, plan, rig):
        left = rig.measured(abs(float(at.deviation[-1])), 3)
        yield f"{stays}: it leaves {left} after {HORIZON:g} settling times"


def load_stays(at: LoadRejection | None, plan: Plan, rig: RigDescription) -> Iterator[str]:
    """What to do where a load step stays; nothing where it vanishes."""
    if at is None or at.vanishes:
        return
    if plan.cost.rejection:
        yield "a load step stays"
    elif rig.limits.load_max_N:
        yield f"a load step stays, tune with --cost {BALANCED}"
    else:
        yield "a load step stays, and the rig makes none to tune with: raise the lower bound of I"
