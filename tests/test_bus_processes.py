"""Rigs and clients as processes: how each end is noticed by the other side."""

import signal

import pytest

from estune.errors import RigError
from estune.remote import zenoh
from estune.remote.state_machine.state import Mode
from estune.remote.zenoh.network import Network
from estune.trial import Outcome
from tests.serve_rig import served
from tests.support_rigs import ScriptedRig
from tests.test_bus import SOON_S, end, script, trial, until


@pytest.mark.slow
def test_client_process_ends_without_close():
    text = """
import sys
from estune.remote import zenoh
from tests.test_bus import trial
rig = zenoh.connect(sys.argv[1])
print(rig.run(trial()).outcome)
"""
    with served("scripted") as server:
        assert end(script(text, server.endpoint)).split() == ["done"]


@pytest.mark.slow
def test_server_process_without_close_stops_its_trial_and_ends():
    text = """
import threading
from estune.remote import zenoh
from tests.support_rigs import ScriptedRig
from tests.test_bus import trial

class PrintingRig(ScriptedRig):
    def _perform(self, request):
        record = super()._perform(request)
        print(record.outcome)
        return record

rig = PrintingRig(duration_s=100.0)
server = zenoh.serve(rig)
client = zenoh.connect(server.endpoint)
threading.Thread(target=client.run, args=(trial(),), daemon=True).start()
while not rig.requests:
    pass
"""
    assert "cancelled" in end(script(text))


@pytest.mark.slow
def test_ctrl_c_interrupts_run_and_abort_stops_the_trial():
    text = """
import signal, sys
from estune.remote import zenoh
from tests.test_bus import trial
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell's & has it ignored
with zenoh.connect(sys.argv[1]) as rig:
    try:
        print("running", flush=True)
        rig.run(trial())
    except KeyboardInterrupt:
        print(rig.abort().name)
"""
    with served("slow scripted") as server, zenoh.connect(server.endpoint) as witness:
        process = script(text, server.endpoint)
        assert process.stdout.readline() == "running\n"
        until(lambda: witness.status().mode is Mode.RUNNING)
        process.send_signal(signal.SIGINT)
        assert end(process).split() == ["reel"]
        witness.apply(trial().gains)


def test_deleted_remote_rig_closes_its_session():
    with zenoh.serve(ScriptedRig()) as server:
        client = zenoh.connect(server.endpoint)
        client.run(trial())  # which begins to keep a lease
        session = client._connection.session
        del client
        assert session.is_closed()


def test_rigs_of_a_network_share_a_session_until_the_last_is_closed():
    network = Network()
    with zenoh.serve(ScriptedRig()) as server:
        first, second = (zenoh.connect(server.endpoint, network=network) for _ in range(2))
        session = first._connection.session
        assert second._connection.session is session
        first.run(trial())
        first.close()
        assert second.run(trial(1)).outcome is Outcome.DONE
        second.close()
        assert session.is_closed()


def test_closed_server_frees_its_port():
    server = zenoh.serve(ScriptedRig())
    server.close()
    server.wait()
    with pytest.raises(RigError, match="nothing"):
        zenoh.connect(server.endpoint, timeout_s=SOON_S)
    with zenoh.serve(ScriptedRig(), server.endpoint) as again:
        assert again.instance != server.instance
    server.close()


def test_closed_session_is_refused_in_words_whatever_is_asked():
    with served("scripted", "reel") as server, zenoh.connect(server.endpoint) as client:
        connection = client._connection
        connection.session.close()
        with pytest.raises(RigError, match="the link has failed"):
            connection.check_liveliness(0.0)
