"""The examination: gathers the evidence, check by check."""

import secrets
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

from estune.doctor import host, link, records, words
from estune.doctor.finding import Finding, State, fine, fix, unknown
from estune.doctor.link import Dated
from estune.profiles import StepProfile
from estune.protocol import Status
from estune.trial import RigDescription, TrialRecord, TrialRequest

REPEATS = 5
GENTLER = 0.5
"""The trial steps by this share of the step that the rig suggests."""


class Patient(Protocol):
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


def examine(
    rig: Patient, endpoint: str, *, move: bool, repeats: int = REPEATS, asked_who: bool = False
) -> Iterator[Finding]:
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
    standing = words.check_standing(rig.status())
    yield standing
    yield link.check_link(link.round_trips_s(rig.status))
    limits = words.check_limits(about)
    yield limits
    yield words.check_gains(about)
    seen = host.find_host(endpoint)
    yield host.check_permissions(seen, simulated=about.simulated)
    yield host.check_ports(seen, endpoint, asked_who=asked_who)
    yield host.check_ledger(seen, simulated=about.simulated)
    if not move:
        yield unknown("trials", "not looked at, for nothing was moved", "estune doctor --move")
    elif State.FIX in (standing.state, limits.state):
        yield unknown("trials", "not looked at: mend the above first", "estune doctor --move")
    else:
        yield from _in_motion(rig, about, repeats)


def _in_motion(rig: Patient, about: RigDescription, repeats: int) -> Iterator[Finding]:
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
    outcomes = records.check_outcomes(found, step)
    yield outcomes
    yield link.check_clock(dated)
    if outcomes.state is State.FINE:
        yield records.check_sampling(found)
        yield records.check_gauge(found, step, simulated=about.simulated)
        yield records.check_cost(found, step, about)
    after = rig.describe().gains
    if after == about.gains:
        yield fine("restored", "the live gains are what they were before")
    else:
        yield fix(
            "restored",
            f"the rig runs {after} after the trials, not {about.gains} as before",
            "its program must put the live gains back after every trial",
        )
