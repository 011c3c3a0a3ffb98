"""Conformance of a rig: lease, emergency stop, invalid and foreign commands."""

import json
import math
import time
from dataclasses import fields, replace
from typing import Any, get_type_hints

import pytest
import zenoh

from estune.conformance.wire_client import ANSWERED_WITHIN_S, HOLDER, WireClient
from estune.remote import messages
from estune.remote.messages import VERBS, Answer, Following, digest
from estune.remote.messages.commands import (
    Clear,
    Estop,
    Lease,
    SetGains,
    Submit,
    SwitchOff,
    Void,
)
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, Mode
from estune.trial import Outcome, Setpoint, TrialRequest


def example(wire: WireClient, verb: str, request: TrialRequest) -> Any:
    """A valid command that would have an effect."""
    gains = wire.describe().rig.gains
    values: dict[str, Any] = {
        "action": "release",
        "lease": wire.lease,
        "holder": "wildcard",
        "reason": "wildcard",
        "request": request,
        "trial_id": request.trial_id,
        "digest": digest(request),
        "gains": replace(gains, P=0.8 * gains.P),
        "tables": ("friction",),
        "sent_s": time.monotonic(),
        "setpoint": Setpoint(wire.describe().rig.step.preload_N),
    }
    kind: Any = VERBS[verb].message
    hints, of_type = get_type_hints(kind), {float: 1.0, int: 1, str: "wildcard", bool: True}
    names = (field.name for field in fields(kind))
    return kind(**{name: values.get(name, of_type.get(hints[name])) for name in names})


class CommandTests:
    """Tests of commands."""

    def test_commands_without_the_lease_are_refused_with_the_holder(
        self, wire: WireClient
    ) -> None:
        request, mine = wire.trial(), wire.lease
        wire.lease = "0" * 16
        gains = wire.describe().rig.gains
        for answer in (
            wire.send("lease", Lease("acquire", wire.lease, "another")),
            *(wire.send("lease", Lease(action, wire.lease)) for action in ("renew", "release")),
            wire.submit(request),
            wire.send("gains", SetGains(wire.lease, gains)),
            *wire.sent_if_served("switch_off", SwitchOff(wire.lease, ("friction",))),
            wire.send("void", Void(wire.lease, request.trial_id, digest(request))),
        ):
            assert answer.verdict is ReplyCode.HELD
            assert HOLDER in answer.sentence
        assert wire.code(request) is ReplyCode.UNKNOWN
        wire.send("lease", Lease("release", mine))
        assert wire.submit(request).verdict is ReplyCode.NO_LEASE
        assert wire.status().holder == ""
        wire.lease = mine
        wire.acquire()

    def test_a_compensation_that_is_not_on_cannot_be_switched_off(self, wire: WireClient) -> None:
        wire.need("switch_off")
        before = wire.describe()
        for tables in (("no_such_table",), ("friction", "no_such_table")):
            answer = wire.send("switch_off", SwitchOff(wire.lease, tables))
            assert answer.verdict is ReplyCode.REFUSED
            assert answer.sentence
        assert wire.describe() == before

    def test_lease_not_renewed_expires_and_stops_the_trial(self, wire: WireClient) -> None:
        request = wire.long_trial()
        wire.submit(request)
        wire.until(Mode.RUNNING)
        began_s = time.monotonic()
        wire.until(Mode.IDLE, renew=False)
        assert time.monotonic() - began_s > LEASE_S / 2
        record = wire.record(request)
        assert (record.outcome, bool(record.reason)) == (Outcome.CANCELLED, True)
        assert wire.submit(wire.trial(1)).verdict is ReplyCode.NO_LEASE
        wire.acquire()

    def test_lease_released_stops_the_trial(self, wire: WireClient) -> None:
        request = wire.long_trial()
        wire.submit(request)
        wire.until(Mode.RUNNING)
        wire.send("lease", Lease("release", wire.lease))
        wire.until(Mode.IDLE, renew=False)
        assert wire.record(request).outcome is Outcome.CANCELLED
        wire.acquire()

    @pytest.mark.parametrize(
        "payload", [b"", b'{"reason":"smoke"}', b'{"reason":""}', b"\xff{", b'{"reason":3}']
    )
    def test_estop_with_any_payload_is_obeyed_and_holds_until_clear(
        self, wire: WireClient, payload: bytes
    ) -> None:
        request, gains = wire.long_trial(), wire.describe().rig.gains
        wire.submit(request)
        wire.until(Mode.RUNNING)
        assert wire.send("estop", payload).verdict is ReplyCode.ACCEPTED
        status = wire.until(Mode.SAFE)
        assert bool(status.latched)
        assert wire.record(request).outcome is Outcome.CANCELLED
        for answer in (
            wire.submit(wire.trial(1)),
            wire.send("gains", SetGains(wire.lease, gains)),
            *wire.sent_if_served("switch_off", SwitchOff(wire.lease, ("friction",))),
        ):
            assert answer.verdict is ReplyCode.SAFE
        assert wire.send("estop", Estop("again")).verdict is ReplyCode.ACCEPTED
        assert wire.status().latched == status.latched
        held, wire.lease = wire.lease, "0" * 16
        assert wire.submit(wire.trial(1)).verdict is ReplyCode.SAFE
        wire.lease = held
        assert wire.send("clear", Clear()).verdict is ReplyCode.ACCEPTED
        assert wire.status().mode is Mode.LEASED
        wire.submit(wire.trial(1))
        assert wire.record(wire.trial(1)).outcome is Outcome.DONE

    def test_invalid_commands_are_refused_without_effect(self, wire: WireClient) -> None:
        request = wire.trial()
        good = json.loads(messages.encode(Submit(wire.lease, request, digest(request))))
        wrong = [b"", b"\xff\xfe", b"[]", b"[" * 2000, b'{"x":1}', b"{}" + b" " * 2048]
        wrong += [
            json.dumps(good | changes).encode()
            for changes in ({"colour": "red"}, {"digest": 3}, {"request": None})
        ]
        nested = json.loads(json.dumps(good))
        for value in (float("nan"), "1", None, -1.0, 0.0):
            nested["request"]["gains"]["P"] = value
            wrong.append(json.dumps(nested).encode())
        for verb in [name for name in VERBS if name != "estop" and not wire.lacks(name)]:
            for payload in wrong:
                answer = wire.send(verb, payload)
                assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "ProtocolError")
        assert wire.code(request) is ReplyCode.UNKNOWN
        assert wire.status().mode is Mode.LEASED

    def test_setpoint_is_followed_or_refused_with_a_reason(self, wire: WireClient) -> None:
        wire.need("follow")
        about, sent_s = wire.describe().rig, time.monotonic()
        preload = about.step.preload_N
        answer = wire.follow(preload, sent_s)
        if isinstance(answer, Answer):
            assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")
            assert bool(answer.sentence)
            return
        assert answer.sent_s == sent_s
        later = wire.follow(preload, sent_s + 0.01)
        assert isinstance(later, Following)
        assert later.feedback.time_s >= answer.feedback.time_s
        for setpoint_N, at_s, error in (
            (preload, sent_s, "StaleSetpoint"),  # older than the last, or the same again
            (preload, sent_s - 10.0, "StaleSetpoint"),
            (math.nextafter(about.limits.tension_max_N, math.inf), sent_s + 1.0, "InvalidInput"),
            (about.limits.tension_min_N - 1.0, sent_s + 1.0, "InvalidInput"),
            (math.nan, sent_s + 1.0, "ProtocolError"),
            (preload, math.nan, "ProtocolError"),
        ):
            refused = wire.follow(setpoint_N, at_s)
            assert isinstance(refused, Answer)
            assert (refused.verdict, refused.error) == (ReplyCode.REFUSED, error)

    def test_setpoint_is_refused_during_a_trial_in_the_safe_state_and_without_the_lease(
        self, wire: WireClient
    ) -> None:
        wire.need("follow")
        preload, mine = wire.describe().rig.step.preload_N, wire.lease

        def code() -> ReplyCode:
            answer = wire.follow(preload, time.monotonic())
            assert isinstance(answer, Answer)
            return answer.verdict

        wire.lease = "0" * 16
        assert code() is ReplyCode.HELD
        wire.lease = mine
        request = wire.long_trial()
        wire.submit(request)
        wire.until(Mode.RUNNING)
        assert code() is ReplyCode.BUSY
        wire.send("estop", Estop("a setpoint must not move the rig now"))
        wire.until(Mode.SAFE)
        assert code() is ReplyCode.SAFE
        wire.send("clear", Clear())

    def test_original_gains_are_kept_with_the_live_ones_or_refused(self, wire: WireClient) -> None:
        original = wire.describe().rig.gains
        live = replace(original, P=0.9 * original.P)
        answer = wire.send("gains", SetGains(wire.lease, live, original))
        if answer.verdict is ReplyCode.REFUSED:  # a rig without a place for them says so at once
            assert answer.error == "ProtocolError"
            assert wire.describe().rig.gains == original
            return
        description = wire.describe()
        assert (description.rig.gains, description.original) == (live, original)
        wire.send("gains", SetGains(wire.lease, original))
        description = wire.describe()
        assert (description.rig.gains, description.original) == (original, None)

    def test_command_on_a_foreign_key_is_not_executed(self, wire: WireClient) -> None:
        request = wire.trial()
        payload = messages.encode(Submit(wire.lease, request, digest(request)))
        keys = ("reel/**", f"{wire.keys.root}/*/*/submit", wire.keys.command("0" * 8, "submit"))
        for key in keys:
            target = zenoh.QueryTarget.ALL
            for reply in wire.session.get(key, payload=payload, target=target, timeout=5.0):
                assert reply.ok is None or "@cmd" not in str(reply.ok.key_expr)
        assert wire.code(request) is ReplyCode.UNKNOWN

    @pytest.mark.parametrize("verb", VERBS)
    @pytest.mark.parametrize("key", ["reel/v1/*/@cmd/*/{}", "{root}/@cmd/*/{}", "{root}/@cmd/**"])
    def test_command_on_a_wildcard_key_is_neither_executed_nor_answered(
        self, wire: WireClient, verb: str, key: str
    ) -> None:
        request, before = wire.trial(), wire.describe()
        if verb == "clear":
            wire.send("estop", Estop("to be cleared by its own key only"))
            wire.until(Mode.SAFE)
        status = wire.status()
        replies = wire.session.get(
            key.format(verb, root=wire.keys.root),
            payload=messages.encode(example(wire, verb, request)),
            target=zenoh.QueryTarget.ALL,
            timeout=ANSWERED_WITHIN_S,
        )
        assert not [reply for reply in replies if reply.ok is not None]
        wire.renew()
        assert (wire.status(), wire.describe()) == (status, before)
        assert wire.code(request) is ReplyCode.UNKNOWN

    @pytest.mark.parametrize("name", ["status", "describe"])
    def test_query_on_a_wildcard_key_is_answered_on_the_rigs_own_key(
        self, wire: WireClient, name: str
    ) -> None:
        own = getattr(wire.keys, name)
        for key in (f"reel/v1/*/{name}", f"reel/*/*/{name}", f"{wire.keys.root}/{name[:3]}$*"):
            replies = wire.session.get(
                key,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWERED_WITHIN_S,
            )
            samples = [reply.ok for reply in replies if reply.ok is not None]
            mine = [s for s in samples if s.attachment == zenoh.ZBytes(wire.instance)]
            assert [str(sample.key_expr) for sample in mine] == [own]
