"""The daemon over the link and on the command line: messages, commands, records."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.cli import daemon as cli_daemon
from estune.cli import run
from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote.messages.codec import decode, encode
from estune.remote.messages.daemon import Command, CommandAnswer, Request
from estune.trial import Outcome, TrialRequest, record_checks
from tests.support_daemon import ORIGINAL, daemon, rig_served, rig_table
from tests.support_rigs import description, diverged, response


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_decode_refuses_arbitrary_bytes(data):
    for kind in (Command, Request):
        try:
            message = decode(kind, data)
        except ProtocolError:
            continue
        assert decode(kind, encode(message)) == message


@pytest.mark.parametrize(
    "data",
    [
        b'{"command_id": "0123456789abcdef", "who": "me", "force": true}',
        b'{"command_id": "0123456789abcdeg", "who": "me"}',
        b'{"command_id": "0123456789abcdef", "who": ""}',
        b'{"command_id": "0123456789abcdef", "who": "' + b"x" * 3000 + b'"}',
    ],
)
def test_decode_refuses_malformed_commands(data):
    with pytest.raises(ProtocolError):
        decode(Command, data)


def test_repeated_command_is_executed_once(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        supervision, command = it.service._supervised["drum"], Command("ab" * 8, "me")
        first = supervision.command("pause", command)
        assert first.done
        it.command("resume")
        assert supervision.command("pause", command) == first
        assert it.until_mode("holding").paused == ""
        assert isinstance(first, CommandAnswer)


def test_command_on_a_wildcard_key_is_not_executed(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        for key in ("reel/v1/drum/daemon/@cmd/*/pause", "reel/v1/*/daemon/@cmd/*/pause"):
            payload = encode(Command("cd" * 8, "me"))
            assert not list(it.client._session.get(key, payload=payload, timeout=1.0))
        assert it.client.status("drum").paused == ""
        assert it.client.history("drum").commands == []


REQUEST = TrialRequest("run", 0, ORIGINAL, description().step)
FAULTS = [
    ({}, ""),
    ({"trial_id": "run-00007"}, "stale"),
    ({"rig": "other"}, "another rig"),
    ({"gains": replace(ORIGINAL, P=9.0)}, "was run with"),
    ({"sampling_Hz": 201.0}, "sampled at 201 Hz"),
    ({"started_at": "yesterday"}, "not in ISO 8601"),
    ({"started_at": "2009-05-04T12:00:00"}, "no offset"),
    ({"angle_rad": np.zeros(3)}, "differ in length"),
    ({"current_A": np.full(100, np.inf)}, "current_A is inf at sample 0"),
    ({"time_s": np.arange(100)[::-1] / 200.0}, "clock jumps"),
    ({"time_s": np.arange(100) / 200.0 + 9.0 * (np.arange(100) > 50)}, "at sample 51"),
]


@pytest.mark.parametrize(("changes", "words"), FAULTS)
def test_record_fault_names_what_is_wrong(changes, words):
    record = replace(response(REQUEST), **changes)
    fault = record_checks.record_fault(record, REQUEST, description())
    assert words in fault
    assert bool(fault) is bool(words)


@pytest.mark.parametrize(
    ("step_N", "error_N", "is_fault"),
    [
        (5.0, 0.04, False),
        (5.0, 0.06, True),
        (-5.0, 0.06, True),
        (0.001, 1e-4, False),  # what single precision leaves of 20 N is no other setpoint
        (0.001, 3e-4, True),
    ],
)
def test_setpoint_is_that_asked_for_within_a_hundredth_of_its_range_and_rounding(
    step_N, error_N, is_fault
):
    profile = replace(REQUEST.profile, preload_N=20.0, step_N=step_N)
    request = replace(REQUEST, profile=profile)
    record = response(request)
    ran = replace(record, setpoint_N=record.setpoint_N + error_N)
    fault = record_checks.record_fault(ran, request, description())
    assert ("setpoint at sample 0" in fault) is is_fault
    assert bool(fault) is is_fault


def test_record_fault_accepts_diverged_and_short_trials():
    for record in (
        diverged(REQUEST),
        replace(diverged(REQUEST), outcome=Outcome.GUARD),
    ):
        assert record_checks.record_fault(record, REQUEST, description()) == ""


def test_daemon_control_shows_and_commands(tmp_path, capsys):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        endpoint = it.service.endpoint

        def say(*words: str) -> str:
            assert run(["daemon-control", *words]) == 0
            return capsys.readouterr().out

        heads, row = say("status", endpoint).splitlines()
        assert heads.split() == ["rig", "mode", "live", "run", "cost"]
        assert re.match(r"drum +holding: .*  original gains; no others accepted yet ", row)
        facts = say("status", endpoint, "--rig", "drum")
        assert re.search(r"^live +original gains; no others accepted yet", facts, re.MULTILINE)
        assert re.search(r"^candidate is +better than the initial gains: ", facts, re.MULTILINE)
        statuses = json.loads(say("status", endpoint, "--json"))
        assert statuses[0]["gains"]["original"]["P"] == ORIGINAL.P
        accepted = say("accept", endpoint, "--why", "looks good")
        assert "accept by" in accepted
        assert re.search(r"^live +accepted gains", accepted, re.MULTILINE)
        assert "looks good" in say("history", endpoint)
        assert "better than the initial gains" in say("events", endpoint)
        assert run(["daemon-control", "accept", endpoint]) == InvalidInput.exit_code
        assert "no candidate gains" in capsys.readouterr().err
        assert run(["daemon-control", "status", endpoint, "--rig", "other"]) == RigError.exit_code
        assert "there is: drum" in capsys.readouterr().err
        trials = it.client.status("drum").trials
        stopped = say("stop", endpoint)
        assert re.search(r"^mode +stopped", stopped, re.MULTILINE)
        it.thread.join()
        assert it.service._supervised["drum"].live == "accepted"
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        assert it.client.status("drum").trials == trials > 0


def test_watched_status_is_a_line_of_json_for_each_change(tmp_path, capsys, monkeypatch):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")

        def accept_then_interrupt(_seconds):
            if it.client.status("drum").mode != "holding":
                raise KeyboardInterrupt
            it.command("accept")
            it.until_mode("watching")

        monkeypatch.setattr(cli_daemon, "time", SimpleNamespace(sleep=accept_then_interrupt))
        assert run(["daemon-control", "status", it.service.endpoint, "--watch", "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [json.loads(line)[0]["home"] for line in lines][:2] == ["original", "accepted"]
