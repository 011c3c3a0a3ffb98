"""Conformance of a rig: trials, their records and their ids."""

from dataclasses import replace

import numpy as np
import pytest
import zenoh

from estune.conformance.wire_client import HOLDER, PENDING, WireClient
from estune.core.gains import Gains
from estune.remote import messages
from estune.remote.messages import Answer, Part, Status, digest
from estune.remote.messages.commands import Cancel, Clear, SetGains, Void
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.trial import SATURATED, Outcome
from estune.trial.loop_records import recomputed_effort

EFFORT_ERROR_MAX = 0.05
"""Largest standard deviation of the logged effort from the recomputed one, relative to its own."""


class TrialTests:
    """What a client may rely on between `submit` and the result."""

    def test_describe_is_constant_and_within_its_own_limits(self, wire: WireClient) -> None:
        about = wire.describe()
        assert (about.rig.name, about.instance) == (wire.keys.rig, wire.instance)
        assert about.ledger
        about.rig.limits.check(about.rig.step)
        assert wire.describe() == about

    def test_submit_repeated_runs_the_trial_once_as_requested(self, wire: WireClient) -> None:
        request, before = wire.trial(), wire.describe().rig
        ended = wire.status().ended
        first = wire.submit(request)
        assert first.verdict in (*PENDING, ReplyCode.ENDED)
        record = wire.record(request)
        assert (record.trial_id, record.rig) == (request.trial_id, before.name)
        assert (record.outcome, record.gains) == (Outcome.DONE, request.gains)
        setpoint = request.profile.setpoint(record.sampling_Hz)
        np.testing.assert_allclose(record.setpoint_N, setpoint, rtol=1e-6)
        assert np.all(np.isfinite(record.tension_N))
        assert wire.describe().rig.gains == before.gains
        again = wire.submit(request)
        assert again.verdict is ReplyCode.ENDED
        assert wire.status().ended == ended + 1

    def test_ramp_to_the_setpoint_is_run_as_requested_or_refused(self, wire: WireClient) -> None:
        step = wire.describe().rig.step
        request = wire.trial(ramp_s=0.4 * (step.duration_s - step.step_at_s))
        answer = wire.submit(request)
        if answer.verdict is ReplyCode.REFUSED:
            assert answer.error in ("InvalidInput", "ProtocolError")
            assert wire.code(request) is ReplyCode.UNKNOWN
            return
        record = wire.record(request)
        setpoint = request.profile.setpoint(record.sampling_Hz)
        np.testing.assert_allclose(record.setpoint_N, setpoint, rtol=1e-6)

    def test_current_follows_from_setpoint_tension_and_the_trials_gains(
        self, wire: WireClient
    ) -> None:
        about = wire.describe().rig
        live, step = about.gains, replace(about.step, step_N=0.5 * about.step.step_N)
        lag_s = live.setpoint_filter_s + 0.5 * about.settling_time_s
        gains = Gains(0.7 * live.P, 0.7 * live.I, 0.7 * live.D, lag_s)
        request = replace(wire.trial(), gains=gains, profile=step)
        wire.submit(request)
        record = wire.record(request)
        logged = record.controller_A * about.newtons_per_ampere
        if (record.flags & SATURATED).any():
            pytest.skip("the effort was at its limit; let the rig suggest a smaller step")
        apart = recomputed_effort(record, about, float(logged[0])) - logged
        error = float(np.std(apart)) / max(float(np.std(logged)), 1e-300)
        assert error < EFFORT_ERROR_MAX, (
            f"the logged effort is {error:.0%} of its variation from the one that setpoint, "
            "tension and the trial's gains give by the declared controller: the rig applies other "
            "gains or no setpoint filter, its current is in another unit, or its controller has "
            "another form than it declares"
        )

    def test_result_in_parts_equals_the_whole_frame(self, wire: WireClient) -> None:
        request = wire.trial()
        wire.submit(request)
        wire.record(request)
        whole = wire.frame(request)
        data = b""
        while len(data) < len(whole):
            part = wire.inquire(request, offset=len(data), length=700)
            assert isinstance(part, Part)
            assert (part.offset, part.total, len(part.data) <= 700) == (
                len(data),
                len(whole),
                True,
            )
            data += part.data
        assert data == whole
        for offset in (len(whole), -1):
            beyond = wire.inquire(request, offset=offset)
            assert isinstance(beyond, Answer)
            assert (beyond.verdict, beyond.error) == (ReplyCode.REFUSED, "ProtocolError")

    def test_submit_of_another_request_under_a_used_id_is_refused(self, wire: WireClient) -> None:
        request = wire.trial()
        wire.submit(request)
        wire.record(request)
        other = replace(request, gains=replace(request.gains, P=1.1 * request.gains.P))
        for answer in (wire.submit(other), wire.inquire(other)):
            assert isinstance(answer, Answer)
            assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")

    def test_result_of_a_trial_never_submitted_is_unknown(self, wire: WireClient) -> None:
        assert wire.code(wire.trial(99)) is ReplyCode.UNKNOWN

    def test_submit_outside_the_limits_is_refused(self, wire: WireClient) -> None:
        limits = wire.describe().rig.limits
        too_high = 2.0 * limits.tension_max_N if np.isfinite(limits.tension_max_N) else 1e300
        wrong = [{"step_N": too_high}, {"duration_s": 2.0 * limits.duration_max_s + 1.0}]
        if np.isfinite(limits.tension_min_N):
            wrong.append({"preload_N": limits.tension_min_N - 1.0})
        for number, changes in enumerate(wrong):
            answer = wire.submit(wire.trial(number, **changes))
            assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "InvalidInput")
            assert wire.code(wire.trial(number, **changes)) is ReplyCode.UNKNOWN

    def test_submit_during_a_trial_is_busy_until_cancel_ends_it(self, wire: WireClient) -> None:
        request, gains = wire.long_trial(), wire.describe().rig.gains
        wire.submit(request)
        status = wire.until(Mode.RUNNING)
        assert (status.trial_id, status.holder) == (request.trial_id, HOLDER)
        for answer in (
            wire.submit(wire.trial(1)),
            wire.send("gains", SetGains(wire.lease, gains)),
        ):
            assert (answer.verdict, answer.trial_id) == (ReplyCode.BUSY, request.trial_id)
        wire.check_prompt(wire.describe)
        wire.check_prompt(wire.status)
        assert wire.send("clear", Clear()).verdict is ReplyCode.BUSY
        wire.renew()
        another = wire.send("cancel", Cancel(wire.lease, "another-00000"))
        assert another == Answer(ReplyCode.ACCEPTED)
        assert wire.status().mode is Mode.RUNNING
        while (
            answer := wire.submit(request)
        ).verdict is ReplyCode.ACCEPTED:  # the mode changes before the ledger does
            wire.renew()
        assert answer.verdict is ReplyCode.RUNNING
        while wire.send("cancel", Cancel(wire.lease)).trial_id:
            wire.renew()
        record = wire.record(request)
        assert (record.outcome, bool(record.reason)) == (Outcome.CANCELLED, True)
        assert wire.describe().rig.gains == gains
        assert wire.send("cancel", Cancel(wire.lease)) == Answer(ReplyCode.ACCEPTED)

    def test_void_trial_never_runs(self, wire: WireClient) -> None:
        request, ended = wire.trial(), wire.status().ended
        void = Void(wire.lease, request.trial_id, digest(request))
        assert wire.send("void", void).verdict is ReplyCode.VOID
        assert wire.submit(request).verdict is ReplyCode.VOID
        assert wire.code(request) is ReplyCode.VOID
        other = wire.trial(1)
        wire.submit(other)
        wire.record(other)
        late = Void(wire.lease, other.trial_id, digest(other))
        assert wire.send("void", late).verdict is ReplyCode.ENDED
        assert wire.send("void", replace(late, lease="")).verdict is ReplyCode.ENDED
        assert wire.status().ended == ended + 1

    def test_gains_set_are_live(self, wire: WireClient) -> None:
        before = wire.describe().rig.gains
        other = replace(before, P=0.8 * before.P)
        for gains in (other, before):
            assert wire.send("gains", SetGains(wire.lease, gains)).verdict is ReplyCode.ACCEPTED
            assert wire.describe().rig.gains == gains

    def test_status_is_published_at_each_change(self, wire: WireClient) -> None:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(100)
        with wire.session.declare_subscriber(wire.keys.status, ring) as subscriber:
            request = wire.trial()
            wire.submit(request)
            wire.record(request)
            ended = wire.status().ended
            while True:
                sample = wire.next_sample(subscriber)
                assert sample.attachment is not None
                assert sample.attachment.to_bytes() == wire.instance.encode()
                if messages.decode(Status, sample.payload.to_bytes()).ended == ended:
                    break
