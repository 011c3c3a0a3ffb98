"""Checks of a rig's description and status: limits, live gains, emergency stop."""

import math
from collections.abc import Iterator

from estune.cli.checks.check_result import CheckResult, fine, fix, unknown
from estune.errors import InvalidInput
from estune.interop import margins
from estune.remote.messages import Status
from estune.run.results import result_warnings
from estune.run.results.summary import margin_cells
from estune.trial import RigDescription
from estune.trial.gain_bounds import UNBOUNDED


def check_status(status: Status) -> CheckResult:
    """Whether the rig is out of its emergency stop."""
    if status.latched:
        return fix(
            "state",
            f"held in its safe state after an emergency stop ({status.latched})",
            "check the rig, then: estune clear ENDPOINT",
        )
    held = f", held by {status.holder}" if status.holder else ""
    return fine("state", f"{status.mode.sentence}{held}")


def check_limits(rig: RigDescription) -> CheckResult:
    """Whether the limits are finite, in order, and allow the rig's suggested step."""
    faults = list(_faults(rig))
    if faults:
        return fix("limits", "; ".join(faults), "set the limits in the rig's file, and restart it")
    low, high = rig.limits.tension_min_N, rig.limits.tension_max_N
    return fine(
        "limits",
        f"{low:g} to {rig.measured(high)}, trials up to {rig.limits.duration_max_s:g} s",
        tension_min_N=low,
        tension_max_N=high,
        duration_max_s=rig.limits.duration_max_s,
    )


def _faults(rig: RigDescription) -> Iterator[str]:
    limits, controller, step = rig.limits, rig.controller, rig.step
    ends = {
        f"lowest {rig.measurement_name}": limits.tension_min_N,
        f"highest {rig.measurement_name}": limits.tension_max_N,
        "longest trial": limits.duration_max_s,
        f"lowest {rig.command_name}": controller.output_min_N,
        f"highest {rig.command_name}": controller.output_max_N,
    }
    open_ends = [name for name, value in ends.items() if not math.isfinite(value)]
    if open_ends and not rig.simulated:
        yield f"no limit is set for: {', '.join(open_ends)}"
    try:
        limits.check(step)
    except InvalidInput as error:
        yield f"the rig refuses the step it suggests itself ({error})"
    highest = max(step.extremes)
    holds = not controller.output_max_N < min(limits.tension_max_N, highest)
    if rig.have_one_unit and not holds:
        yield (
            f"the highest {rig.command_name}, {rig.commanded(controller.output_max_N)}, is less "
            f"than the {rig.measured(highest)} of the step it suggests"
        )
    after_s = step.duration_s - step.step_at_s
    if not rig.settling_time_s <= after_s:
        yield (
            f"a settling time of {rig.settling_time_s:g} s does not fit into the {after_s:g} s "
            "after the step"
        )


def check_gain_bounds(rig: RigDescription) -> CheckResult:
    """Which gains the rig accepts, and whether its live ones are among them."""
    live, trial = rig.bounds_of(trial=False), rig.bounds_of(trial=True)
    if UNBOUNDED in (live, trial):
        return unknown(
            "gain bounds", "none: neither the effort nor the rig's file limits the gains"
        )
    try:
        rig.check_gains(rig.gains)
    except InvalidInput as error:
        return fix("gain bounds", str(error), "start the rig with other gains, or wider bounds")
    return fine("gain bounds", f"live {live}; of a trial {trial}")


def check_gains(rig: RigDescription) -> CheckResult:
    """Whether the live gains have sufficient margins on the rig's own model."""
    gains = rig.gains_text(rig.gains)
    if rig.linear_model is None:
        return unknown(
            "live gains",
            f"{gains}; their margins are not stated: the rig gives no linear model",
        )
    measured = margins(rig.linear_model, rig.gains, rig.controller)
    low = result_warnings.low_margins(measured)
    if low:
        return fix(
            "live gains",
            f"{gains}: {low[0].sentence.partition(';')[0]}",
            "give the rig gentler gains before it is tuned",
            gain_margin=measured.gain_margin,
            phase_margin_deg=measured.phase_margin_deg,
        )
    return fine(
        "live gains",
        f"{gains}; {', '.join(map(' '.join, margin_cells(measured)))}",
        gain_margin=measured.gain_margin,
        phase_margin_deg=measured.phase_margin_deg,
    )
