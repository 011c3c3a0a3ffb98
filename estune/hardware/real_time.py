"""Real-time priority of a process."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


def request_priority(priority: int, policy: int = os.SCHED_FIFO) -> str:
    """Requests real time for this thread and those that it starts from now on.

    Args:
        priority: From 1 to 99; 0 requests nothing.
        policy: With `os.SCHED_RESET_ON_FORK`, for this thread alone.

    Returns:
        What was not granted, with its remedy; empty where it was.
    """
    if not priority:
        return ""
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        return (
            f"no real-time priority {priority}: {error.strerror}; give the user an rtprio limit "
            "(limits.conf), or the service LimitRTPRIO="
        )
    return ""


@contextmanager
def prioritised(priority: int) -> Iterator[str]:
    """Requests real time while inside, for this thread and those that it starts; gives it back.

    A thread left in real time keeps every other from a core for as long as it computes.

    Args:
        priority: From 1 to 99; 0 requests nothing.

    Yields:
        What was not granted, with its remedy; empty where it was.
    """
    policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
    refused = request_priority(priority)
    try:
        yield refused
    finally:
        if priority and not refused:
            os.sched_setscheduler(0, policy, before)
