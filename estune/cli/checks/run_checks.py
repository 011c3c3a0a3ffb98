"""The examination: gathers the evidence, check by check."""

import secrets
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

from estune.cli.checks import description_checks, host_checks, link_checks, trial_checks
from estune.cli.checks.check_result import CheckResult, State, fine, fix, unknown
from estune.cli.checks.link_checks import Dated
from estune.remote.messages import Status
from estune.trial import RigDescription, TrialRecord, TrialRequest
from estune.trial.profiles import StepProfile

REPEATS = 5
GENTLER = 0.5
"""The trial steps by this share of the step that the rig suggests."""


class RigUnderTest(Protocol):
    """What is examined: a rig on the link."""

    def describe(self) -> RigDescription:
        """What it is."""
        ...

    def status(self) -> Status:
        """What it does now."""
        ...

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial."""
        ...


def gentle_trial(rig: RigDescription) -> StepProfile:
    """The step that is repeated: half of what the rig suggests itself."""
    return replace(rig.step, step_N=GENTLER * rig.step.step_N)


def run_checks(
    rig: RigUnderTest,
    endpoint: str,
    *,
    move: bool,
    repeats: int = REPEATS,
    asked_who: bool = False,
) -> Iterator[CheckResult]:
    """Examines a rig; each finding comes as soon as it is made.

    Args:
        rig: The rig.
        endpoint: Where it was reached.
        move: Whether it may be moved: by a gentle step with its live gains, so many times.
        repeats: How many times; at least two.
        asked_who: Whether the rig was reached under a name.

    Raises:
        RigError: it cannot be reached, or refuses the trials.
    """
    about = rig.describe()
    standing = description_checks.check_status(rig.status())
    yield standing
    yield link_checks.check_link(link_checks.round_trips_s(rig.status))
    limits = description_checks.check_limits(about)
    yield limits
    yield description_checks.check_gains(about)
    seen = host_checks.find_host(endpoint)
    yield host_checks.check_permissions(seen, simulated=about.simulated)
    yield host_checks.check_ports(seen, endpoint, asked_who=asked_who)
    yield host_checks.check_ledger(seen, simulated=about.simulated)
    if not move:
        yield unknown("trials", "not looked at, for nothing was moved", "estune doctor --move")
    elif State.FIX in (standing.state, limits.state):
        yield unknown("trials", "not looked at: mend the above first", "estune doctor --move")
    else:
        yield from _in_motion(rig, about, repeats)


def _in_motion(rig: RigUnderTest, about: RigDescription, repeats: int) -> Iterator[CheckResult]:
    step = gentle_trial(about)
    run = f"doctor-{secrets.token_hex(4)}"
    found, dated = [], []
    began_s = time.monotonic()
    for number in range(repeats):
        asked_s = time.time()
        record = rig.run(TrialRequest(run, number, about.gains, step))
        elapsed_s = time.monotonic() - began_s
        found.append(record)
        dated.append(Dated(asked_s, time.time(), elapsed_s, record.started_at))
    outcomes = trial_checks.check_outcomes(found, step)
    yield outcomes
    yield link_checks.check_clock(dated)
    if outcomes.state is State.FINE:
        yield trial_checks.check_sampling(found)
        yield trial_checks.check_gauge(found, step, simulated=about.simulated)
        yield trial_checks.check_cost(found, step, about)
    after = rig.describe().gains
    if after == about.gains:
        yield fine("restored", "the live gains are what they were before")
    else:
        yield fix(
            "restored",
            f"the rig runs {after} after the trials, not {about.gains} as before",
            "its program must put the live gains back after every trial",
        )
