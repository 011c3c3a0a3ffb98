"""Admission: places for rigs, turns for trials, and their number in an overload."""

import threading

import pytest

from estune.daemon.admission import Admission
from estune.errors import RigError
from estune.remote.state_machine.state import LEASE_S

LATE_S, PUNCTUAL_S = 0.9 * LEASE_S, 0.1 * LEASE_S


class Renewal:
    """Ages of leases as given, of a renewal that is not running."""

    def __init__(self, *ages_s: float) -> None:
        self.ages = list(ages_s)

    def ages_s(self) -> list[float]:
        return self.ages


def adjusted(admission: Admission, times: int) -> Admission:
    for _ in range(times):
        admission._adjusted_s = 0.0  # long ago
        admission.adjust()
    return admission


def running_at_once(admission: Admission, trials: int) -> int:
    """How many of so many trials, begun by threads of their own, run while none ends."""
    begun, end = threading.Semaphore(0), threading.Event()
    waiting = threading.Semaphore(0)

    def run():
        with admission.computing, admission.trial(lambda reason: reason and waiting.release()):
            begun.release()
            assert end.wait(60.0)

    threads = [threading.Thread(target=run) for _ in range(trials)]
    for thread in threads:
        thread.start()
    count = 0
    for _ in range(trials):
        while not begun.acquire(timeout=0.01):
            if waiting.acquire(blocking=False):
                break
        else:
            count += 1
            continue
        break
    end.set()
    for thread in threads:
        thread.join(60.0)
    return count


def test_late_renewals_reduce_the_trials_at_once_until_renewals_are_on_time():
    renewal = Renewal(*[PUNCTUAL_S] * 10)
    admission = adjusted(Admission(renewal, rigs=10), 3)
    assert running_at_once(admission, 10) == 10
    renewal.ages = [LATE_S] * 10
    adjusted(admission, 30)
    assert running_at_once(admission, 3) == 1
    renewal.ages = [PUNCTUAL_S] * 10
    adjusted(admission, 30)
    assert running_at_once(admission, 10) == 10


def test_few_late_leases_are_the_fault_of_their_rigs():
    renewal = Renewal(*[PUNCTUAL_S] * 19, LATE_S)
    assert running_at_once(adjusted(Admission(renewal, rigs=5), 30), 5) == 5


def test_trial_given_up_while_it_waits_leaves_its_turn_to_the_next():
    admission = adjusted(Admission(Renewal(LATE_S), rigs=3), 30)

    def give_up(reason):
        if reason:
            assert "1 of 3 rigs run trials at once" in reason
            raise RigError("stopped")

    running, given_up = admission.trial(lambda _: None), admission.trial(give_up)
    with admission.computing, running, admission.computing, pytest.raises(RigError), given_up:
        pass
    assert running_at_once(admission, 1) == 1


def test_places_are_limited_by_number_and_by_load():
    renewal = Renewal()
    admission = Admission(renewal, rigs=5, rigs_max=2)
    assert not admission.take_place("a")
    assert not admission.take_place("a")  # it has one
    renewal.ages = [LATE_S]
    assert "overloaded" in admission.take_place("b")
    renewal.ages = [PUNCTUAL_S]
    assert not admission.take_place("b")
    assert "rigs_max" in admission.take_place("c")
    admission.leave_place("a")
    assert not admission.take_place("c")
