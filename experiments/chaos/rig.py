"""A rig process: a simulated reel that moves in its own time, served with a ledger on disk.

    python -m experiments.chaos.rig NAME ENDPOINT LEDGER PACE [ROUTER]

It logs its motions on standard output.
"""

import sys
from pathlib import Path

import plants
from estune.errors import EstuneError
from estune.remote.zenoh import serve
from experiments.chaos.motions import LoggedRig
from experiments.chaos.processes import ready

SEED = 7


def reference_rig(name: str, pace: float = 0.0) -> plants.SimulatedRig:
    """The reel whose noise depends on the number of a trial alone."""
    return plants.reference_reel().rig(name=name, seed=SEED, pace=pace)


def main(name: str, endpoint: str, ledger: str, pace: str, *routers: str) -> int:
    """Serves until stopped; returns the exit code."""
    ready()
    rig = LoggedRig(reference_rig(name, float(pace)))
    try:
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
