"""All checks of a rig, in order, with their evidence."""

import secrets
import time
from collections.abc import Iterator
from dataclasses import replace

from estune.cli.checks import (
    current_loop_check,
    description_checks,
    host_checks,
    link_checks,
    trial_checks,
)
from estune.cli.checks.check_result import CheckResult, State, fine, fix, unknown
from estune.cli.checks.link_checks import Dated
from estune.errors import EstuneError
from estune.remote.zenoh import RemoteRig
from estune.trial import Outcome, Rig, RigDescription, TrialRequest
from estune.trial.profiles import StepProfile

REPEATS = 5
GENTLER = 0.5
"""Step of the check trials, relative to the step that the rig suggests."""


MOVE = unknown("trials", "not checked, because nothing may move", "use estune doctor --move")
FAILED = unknown(
    "trials",
    "not checked because of the failed checks above",
    "fix those, then use estune doctor --move",
)


def gentle_trial(rig: RigDescription) -> StepProfile:
    """The step of the check trials: half of the suggested one."""
    return replace(rig.step, step_N=GENTLER * rig.step.step_N)


def run_checks(
    rig: RemoteRig,
    endpoint: str,
    *,
    move: bool,
    repeats: int = REPEATS,
    authenticated: bool = False,
) -> Iterator[CheckResult]:
    """Checks a rig; yields each result as soon as it is known.

    With `move`, the rig repeats a gentle step with its live gains.

    Raises:
        RigError: it cannot be reached, or refuses the trials.
    """
    about = rig.describe()
    status = description_checks.check_status(rig.status())
    yield status
    yield link_checks.check_link(link_checks.round_trips_s(rig.status))
    limits = description_checks.check_limits(about)
    yield limits
    yield description_checks.check_gains(about)
    yield description_checks.check_gain_bounds(about)
    host = host_checks.find_host(endpoint)
    yield host_checks.check_permissions(host, simulated=about.simulated, software=about.software)
    yield host_checks.check_ports(host, endpoint, authenticated=authenticated)
    yield host_checks.check_ledger(host, simulated=about.simulated)
    if not move:
        yield MOVE
    elif State.FIX in (status.state, limits.state):
        yield FAILED
    else:
        yield from check_in_motion(rig, about, repeats)


def check_in_motion(rig: Rig, about: RigDescription, repeats: int) -> Iterator[CheckResult]:
    """Checks a rig by a gentle step with its live gains, repeated, and once in an open loop.

    Raises:
        RigError: it refuses the trials.
    """
    step = gentle_trial(about)
    run = f"doctor-{secrets.token_hex(4)}"
    records, dated = [], []
    began_s = time.monotonic()
    for number in range(repeats):
        asked_s = time.time()
        record = rig.run(TrialRequest(run, number, about.gains, step))
        elapsed_s = time.monotonic() - began_s
        records.append(record)
        dated.append(Dated(asked_s, time.time(), elapsed_s, record.started_at))
        # A gentle step with the rig's own gains: the fault is one that a person has to look at.
        if record.outcome is not Outcome.DONE:
            break
    outcomes = trial_checks.check_outcomes(records, step)
    yield outcomes
    yield link_checks.check_clock(dated)
    if outcomes.state is State.FINE:
        yield trial_checks.check_sampling(records)
        quiet = [r.tension_N[: step.step_index(r.sampling_Hz)] for r in records]
        yield trial_checks.check_gauge_rate(quiet, records[0].sampling_Hz)
        yield trial_checks.check_gauge(records, step, about)
        yield trial_checks.check_cost(records, step, about)
        yield _of_current_loop(rig, about, TrialRequest(run, repeats, about.gains, step))
    after = rig.describe().gains
    if after == about.gains:
        yield fine("restored", "the live gains are restored")
    else:
        yield fix(
            "restored",
            f"the rig runs {after} after the trials, not {about.gains} as before",
            "correct the rig's software: it must restore the live gains after every trial",
        )


def _of_current_loop(rig: Rig, about: RigDescription, closed: TrialRequest) -> CheckResult:
    """Check of the current loop by a trial in an open loop, of a plant that comes to rest."""
    gain = current_loop_check.expected_gain(about)
    if gain is None:
        return unknown(
            current_loop_check.CHECK, "not checked: no tension at rest is stated for a current"
        )
    step = gentle_trial(about)
    try:
        record = rig.run(replace(closed, profile=replace(step, loop="open")))
    except EstuneError as error:
        return unknown(
            current_loop_check.CHECK, f"the rig takes no trial in an open loop ({error})"
        )
    return current_loop_check.check_current_loop(record, step, about, gain)
