"""Trials that show that confirmed gains keep the limits of a run, where few of them do."""

from dataclasses import replace

from estune.run.plan import SHOWING_MAX
from estune.run.robustness import verdict_on
from estune.run.session import Session
from estune.run.tuning_run import TuningRun


def showing_limits(run: TuningRun) -> Session:
    """The session of a run, if it is confirmed with one more trial that shows its limits.

    At first up to `SHOWING_MAX` trials may be foretold, then ever fewer. They are repeats of the
    confirmed gains, or excitations with them.
    """
    session, repeats = run.session, run.session.confirmation
    most = session.showing - 1 if session.showing else SHOWING_MAX
    if session.phase is not None or repeats is None or not run.plan.uses_records:
        return session
    session = replace(session, showing=0)
    if session.failure or len(repeats.safe) < 2:
        return session
    verdict = verdict_on(run, repeats.change())
    missing = verdict.missing
    if verdict.fault or not 0 < missing.least <= most:
        return session
    excitation = missing.next_excitation
    if excitation is not None and session.excitation_refused:
        return session
    if excitation is None:
        session = replace(session, confirmation=repeats._replace(ahead=1))
    return replace(session, excitation=excitation, showing=missing.least)
