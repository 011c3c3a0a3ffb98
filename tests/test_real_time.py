"""Real-time priority of a process."""

import os

from estune.hardware.real_time import prioritised


def test_real_time_is_given_back_at_the_end():
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    with prioritised(1) as refused:
        assert refused or os.sched_getscheduler(0) == os.SCHED_FIFO
    assert (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority) == before
