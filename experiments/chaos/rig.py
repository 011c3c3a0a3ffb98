"""A rig process: a simulated reel that moves in its own time, served with a ledger on disk.

    python -m experiments.chaos.rig NAME ENDPOINT LEDGER PACE [ROUTER]

It logs its motions on standard output. With `plain` for a ledger, it is served by a plain Zenoh
queryable that runs every request in its callback.
"""

import json
import sys
import threading
from pathlib import Path

import zenoh

import plants
from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.remote.zenoh import serve
from estune.remote.zenoh.zenoh_session import open_session
from estune.trial import TrialRequest, record_frame
from experiments.chaos.motions import LoggedRig
from experiments.chaos.processes import ready

SEED = 7
PLAIN = "plain"
PLAIN_KEY = "plain/trial"


def reference_rig(name: str, pace: float = 0.0) -> plants.SimulatedRig:
    """The reel whose noise depends on the number of a trial alone."""
    return plants.reference_reel().rig(name=name, seed=SEED, pace=pace)


def serve_plainly(rig: LoggedRig, endpoint: str, routers: list[str]) -> None:
    """Answers each query by running a trial in its callback."""

    def answer(query: zenoh.Query) -> None:
        with query:
            fields = json.loads(bytes(query.payload or b""))
            step = rig.describe().step
            gains = Gains(*fields["gains"])
            request = TrialRequest(fields["run"], fields["number"], gains, step)
            query.reply(PLAIN_KEY, record_frame.encode(rig.run(request)))

    with open_session(
        "peer", listen=(endpoint,), connect=tuple(routers), message_max_bytes=2**24
    ) as session:
        session.declare_queryable(PLAIN_KEY, answer)
        rig.boot()
        threading.Event().wait()


def main(name: str, endpoint: str, ledger: str, pace: str, *routers: str) -> int:
    """Serves until stopped; returns the exit code."""
    ready()
    rig = LoggedRig(reference_rig(name, float(pace)))
    try:
        if ledger == PLAIN:
            serve_plainly(rig, endpoint, list(routers))
        else:
            with serve(rig, endpoint, ledger=Path(ledger), routers=routers) as server:
                rig.boot()
                server.wait()
    except KeyboardInterrupt:
        return 0
    except EstuneError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
