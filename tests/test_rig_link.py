"""The conformance suite on our own rigs, and on a board without estune."""

import subprocess
import sys
from dataclasses import replace

import pytest

from estune.conformance.rig import RigConformance
from estune.conformance.wire_client import WireClient
from estune.errors import RigError
from estune.remote.messages.commands import VERBS, Cancel
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.remote.zenoh.endpoints import with_port
from estune.remote.zenoh.network import RECORDS_MAX_BYTES
from estune.remote.zenoh.zenoh_session import open_session
from estune.trial import Outcome
from tests.serve_rig import hosted, small_board


class TestOwnRig(RigConformance):
    @pytest.fixture(scope="class")
    @classmethod
    def endpoint(cls):
        with hosted("paced simulated") as endpoint:
            yield endpoint


class TestSmallBoard(RigConformance):
    @pytest.fixture(scope="class")
    @classmethod
    def endpoint(cls, tmp_path_factory):
        with small_board(tmp_path_factory.mktemp("board")) as (_, endpoint):
            yield endpoint


def run_suite(*options: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "estune.conformance", *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_suite_on_the_command_line_tests_the_rig_at_the_endpoint(tmp_path):
    with small_board(tmp_path) as (_, endpoint):
        done = run_suite("--endpoint", endpoint, "--rig", "board", "-k", "describe or limits")
        assert done.returncode == 0, done.stdout
        assert " passed" in done.stdout
        done = run_suite("--endpoint", endpoint, "--rig", "another")
        assert done.returncode == RigError.exit_code


@pytest.mark.slow
def test_rig_without_optional_commands_conforms_and_is_told_what_it_lacks(tmp_path):
    optional = [name for name, verb in VERBS.items() if verb.optional]
    with small_board(tmp_path, *optional) as (_, endpoint):
        done = run_suite("--endpoint", endpoint, "-rs")
    assert done.returncode == 0, done.stdout
    for name in optional:
        assert f"the rig lacks the optional command {name} of protocol 1" in done.stdout


@pytest.mark.slow
def test_suite_on_the_command_line_fails_if_no_rig_answers():
    endpoint = with_port("tcp/127.0.0.1:0")
    done = run_suite("--endpoint", endpoint)
    assert done.returncode == RigError.exit_code
    assert f"nothing that speaks Zenoh listens at {endpoint}" in done.stdout + done.stderr
    assert " passed" not in done.stdout


def test_killed_board_reports_the_trial_as_interrupted(tmp_path):
    requests, identities = [], set()
    for kill in (True, False):
        with small_board(tmp_path) as (process, endpoint):
            session = open_session(
                "client", connect=(endpoint,), message_max_bytes=RECORDS_MAX_BYTES
            )
            board = WireClient(session, None)
            identities.add(board.describe().ledger)
            board.acquire()
            if kill:
                requests.append(board.long_trial())
                board.submit(requests[0])
                board.until(Mode.RUNNING)
                process.kill()
            else:
                assert board.submit(requests[0]).verdict is ReplyCode.INTERRUPTED
                board.run, request = requests[0].run, replace(requests[0], attempt=1)
                board.submit(request)
                board.send("cancel", Cancel(board.lease))
                assert board.record(request).outcome is Outcome.CANCELLED
            session.close()
    assert len(identities) == 1
