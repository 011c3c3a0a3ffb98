"""Faults of a supervised rig: codes that do not change between versions, each with its remedy."""

from typing import TypedDict

from estune.core.sentence_enum import SentenceEnum


class FaultCode(SentenceEnum):
    """What has failed, and what to do; in the facts of an event under `FAULT`."""

    RIG_LOST = "rig-lost", "the rig is retried; check its power, its program and the network"
    RIG_HELD = "rig-held", "another daemon has the rig; stop one, or set shared = true in both"
    OTHER_RIG = "other-rig", "connect the folder's own rig, then resume; or give this one its own"
    FOREIGN_GAINS = "foreign-gains", "decide whose gains are right: resume, or revert"
    EMERGENCY_STOP = "emergency-stop", "check the rig, estune clear, then resume"
    TRIAL_CUT_OFF = "trial-cut-off", "the reel may have moved unrecorded; check it, then resume"
    VOID_TRIALS = "void-trials", "read the rig's own log, fix the cause, then resume"
    UNSAFE_GAINS = "unsafe-gains", "the original gains are live; check the machine, then resume"
    DRIFT = "drift", "it is tuned again by itself; look for wear if that happens often"
    REMEDY_LOST = "remedy-lost", "explain new records, then write and prove the remedy anew"
    SETTINGS = (
        "settings",
        "correct the daemon's file, start the daemon again, and resume if it is paused",
    )
    STORAGE = "storage", "make room on the disk, or restore its permissions; it is retried"
    DISK_LOW = "disk-low", "make room on the disk within a day"
    NOT_RESTORED = "not-restored", "start the daemon again, or set the gains by estune apply"
    DAEMON_ERROR = "daemon-error", "it is retried; report it with the traceback in the log"


FAULT = "fault"
"""Name under which the facts of an event hold the code of its fault."""


class EventFacts(TypedDict, total=False):
    """Numbers and names that belong to an event.

    Attributes:
        fault: Code of what has failed, under the name `FAULT`.
        gains: The gains that the event is about, as text.
        cost: Cost of the trial; None where it has none.
    """

    fault: FaultCode
    gains: str
    cost: float | None
