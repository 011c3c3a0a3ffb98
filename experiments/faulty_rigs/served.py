"""Serves a simulated reel with one fault, until its standard input is closed.

python -m experiments.faulty_rigs.served FAULT
"""

import sys
from typing import Any

import plants
from estune.remote.state_machine import rig as machine
from estune.remote.zenoh import rig_server, trial_execution
from estune.remote.zenoh.listening_session import ListeningSession
from estune.remote.zenoh.request_handler import RequestHandler
from experiments.faulty_rigs.faults import COMMANDS, LINK, RUNS_ON, STATE, FaultyRig

PACE = 0.5
"""Duration of a second of a trial, s."""


def serve(fault: str) -> rig_server.RigServer:
    """Serves the reel with a fault."""
    replaced: Any = rig_server
    replaced.RequestHandler = COMMANDS.get(fault, RequestHandler)
    replaced.ListeningSession = LINK.get(fault, ListeningSession)
    replaced = machine
    replaced.step = STATE.get(fault, machine.step)
    if fault == RUNS_ON:
        replaced = trial_execution.SharedRigState
        replaced._stop_trials = lambda _: None  # noqa: SLF001  the fault
    rig: Any = FaultyRig(plants.reference_reel().rig(name="reel", seed=3, pace=PACE), fault)
    return rig_server.serve(rig)


if __name__ == "__main__":
    with serve(sys.argv[1]) as server:
        print(server.endpoint, flush=True)
        sys.stdin.read()
