"""The lease of a client: acquired once, renewed in time, forgotten when the rig refuses it."""

import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from estune.errors import RigError
from estune.remote import messages
from estune.remote.messages import Answer
from estune.remote.messages.commands import Lease
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, RENEW_S
from estune.remote.zenoh import client_lease
from estune.remote.zenoh.client_lease import ClientLease, LeaseRenewal

PERIOD_S = 0.05


class Connection:
    """A rig that answers with given reply codes, the last of them for ever; renewals wait."""

    name = "reel"

    def __init__(self, *verdicts):
        self.verdicts, self.asked, self.renewals = list(verdicts), [], []

    def command(self, command):
        assert len(self.asked) < 1000, "asked for ever"
        self.asked.append(command)
        verdict = self.verdicts.pop(0) if len(self.verdicts) > 1 else self.verdicts[0]
        return Answer(verdict, sentence="held by another")

    def command_key(self, _command):
        return "key"

    def ask(self, _key, payload, timeout_s):
        assert timeout_s < 1.0
        self.asked.append(messages.decode(Lease, payload))

    def send(self, command, receive, timeout_s):
        assert RENEW_S <= timeout_s < 2.0 * RENEW_S  # until the next is sent, not that after it
        self.renewals.append((time.monotonic(), command, receive))

    def own_reply(self, reply):
        return reply

    def reply(self, number, verdict):
        """The rig's reply to a renewal."""
        self.renewals[number][2](messages.encode(Answer(verdict)))


@pytest.fixture
def renewal(monkeypatch):
    monkeypatch.setattr(client_lease, "RENEW_S", PERIOD_S)
    monkeypatch.setattr(client_lease, "AGAIN_S", 0.001)
    return LeaseRenewal()


@pytest.fixture
def held(renewal):
    connection = Connection(ReplyCode.ACCEPTED)
    lease = ClientLease(connection, renewal, "tester")
    lease.hold()
    yield SimpleNamespace(lease=lease, connection=connection, renewal=renewal)
    lease.release()


def renewed(connection, number):
    """Waits for so many renewals."""
    end_s = time.monotonic() + 20.0
    while len(connection.renewals) < number:
        assert time.monotonic() < end_s
        time.sleep(0.001)


def test_lease_is_acquired_once_and_renewed_once_in_a_period(held):
    begun_s = time.monotonic()
    renewed(held.connection, 5)
    took_s = time.monotonic() - begun_s
    assert len(held.connection.renewals) <= took_s / PERIOD_S + 2.0
    assert held.connection.renewals[0][0] - held.lease.renewed_s >= 0.9 * PERIOD_S
    assert held.lease.hold() == held.lease.token
    assert held.connection.asked == [Lease("acquire", held.lease.token, "tester")]
    assert {command for _, command, _ in held.connection.renewals} == {
        Lease("renew", held.lease.token)
    }


def test_renewals_keep_their_period_whatever_each_takes_and_soon_follow_a_stall(
    renewal, monkeypatch
):
    now_s, begun_s, takes = 0.0, [], [0.3, 0.3, 3.0, 0.3, 0.3]

    class Virtual(nullcontext):
        def wait(self, wait_s):
            nonlocal now_s
            now_s += wait_s

    class Slow:
        def renew(self):
            nonlocal now_s
            begun_s.append(now_s)
            now_s += takes.pop(0) * PERIOD_S
            if not takes:
                renewal._leases.clear()

    monkeypatch.setattr(client_lease, "time", SimpleNamespace(monotonic=lambda: now_s))
    renewal._changed, renewal._leases = Virtual(), {Slow()}
    renewal._run()
    assert np.diff(begun_s) / PERIOD_S == pytest.approx([1.0, 1.0, 3.5, 1.0])


def test_age_of_a_lease_counts_from_the_last_request_that_the_rig_granted(held):
    acquired_s = held.lease.renewed_s
    renewed(held.connection, 3)
    assert held.lease.renewed_s == acquired_s  # nothing has arrived
    held.connection.reply(2, ReplyCode.ACCEPTED)
    known_s = held.lease.renewed_s
    assert acquired_s < known_s <= held.connection.renewals[2][0]
    held.connection.reply(1, ReplyCode.ACCEPTED)  # late
    assert held.lease.renewed_s == known_s
    (age_s,) = held.renewal.ages_s()
    assert 0.0 < age_s <= time.monotonic() - known_s
    held.connection.own_reply = lambda _reply: None
    held.connection.reply(2, ReplyCode.NO_LEASE)  # that of another rig
    assert held.renewal.ages_s()
    held.lease.renewed_s -= LEASE_S
    assert not held.renewal.ages_s()


def test_lease_that_the_rig_refuses_is_lost_once_and_acquired_anew(held, caplog):
    lost = held.lease.token
    renewed(held.connection, 2)
    for number in (0, 1):
        held.connection.reply(number, ReplyCode.NO_LEASE)
    assert (held.lease.token, held.lease.losses) == ("", 1)
    assert not held.renewal.ages_s()
    assert held.lease.hold() != lost
    held.connection.reply(0, ReplyCode.NO_LEASE)  # of the lost one
    assert (held.lease.hold(), held.lease.losses) == (held.lease.token, 1)
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_released_lease_is_returned_and_renewed_no_more(held):
    token, thread = held.lease.token, held.renewal._thread
    held.lease.release()
    assert held.connection.asked[-1] == Lease("release", token)
    assert not thread.is_alive()
    before = len(held.connection.renewals)
    held.lease.renew()
    held.lease.release()
    assert len(held.connection.asked) == 2
    assert len(held.connection.renewals) == before


def test_thread_has_ended_when_the_last_lease_is_released_long_before_its_next_renewal(
    renewal, monkeypatch
):
    waits = threading.Event()

    class Watched(threading.Condition):
        def wait(self, timeout=None):
            waits.set()  # release has no lock before this thread waits
            woken = super().wait(timeout)
            time.sleep(0.1)  # a thread that takes its time to end
            return woken

    monkeypatch.setattr(client_lease, "RENEW_S", 600.0)
    renewal._changed = Watched()
    lease = ClientLease(Connection(ReplyCode.ACCEPTED), renewal, "tester")
    lease.hold()
    thread = renewal._thread
    assert waits.wait(20.0)
    lease.release()
    assert not thread.is_alive()


def test_release_of_one_lease_waits_for_no_thread_that_renews_others(held):
    joined_s = []
    held.renewal._thread.join = joined_s.append
    other = ClientLease(Connection(ReplyCode.ACCEPTED), held.renewal, "tester")
    other.hold()
    other.release()
    assert not joined_s
    before = len(held.connection.renewals)
    renewed(held.connection, before + 1)
    del held.renewal._thread.join


def test_rig_held_by_another_client_is_asked_again_until_its_lease_can_have_expired(
    renewal, monkeypatch
):
    connection = Connection(ReplyCode.HELD, ReplyCode.HELD, ReplyCode.ACCEPTED)
    lease = ClientLease(connection, renewal, "tester")
    assert lease.hold()
    assert len(connection.asked) == 3
    lease.release()
    now_s = 0.0

    def sleep(wait_s):
        nonlocal now_s
        now_s += wait_s

    time_s = SimpleNamespace(monotonic=lambda: now_s, sleep=sleep)
    monkeypatch.setattr(client_lease, "time", time_s)
    monkeypatch.setattr(client_lease, "AGAIN_S", 0.01)
    with pytest.raises(RigError, match="held by another"):
        ClientLease(Connection(ReplyCode.HELD), renewal, "tester").hold()
    assert LEASE_S < now_s < 2.0 * LEASE_S
    refusing = Connection(ReplyCode.REFUSED)
    with pytest.raises(RigError, match="held by another"):
        ClientLease(refusing, renewal, "tester").hold()
    assert len(refusing.asked) == 1


def test_lease_may_be_released_by_the_thread_that_renews_it(renewal):
    """There the collector of garbage may close a rig."""
    returned = threading.Event()

    class Closing(Connection):
        def send(self, _command, _receive, _timeout_s):
            lease.release()
            returned.set()

    lease = ClientLease(Closing(ReplyCode.ACCEPTED), renewal, "tester")
    lease.hold()
    assert returned.wait(20.0)


def test_command_refused_for_want_of_a_lease_loses_none(renewal):
    lease = ClientLease(Connection(ReplyCode.ACCEPTED), renewal, "tester")
    lease.drop(lease.token)
    lease.hold()
    lease.drop("that of an earlier lease")
    assert lease.losses == 0
    lease.drop(lease.hold())
    assert (lease.token, lease.losses) == ("", 1)
    lease.release()
