"""A simulated platform or bench in real time, each reel served as a rig.

`python -m plants.bench.cable_platform [platform | bench]` prints a line `rig NAME at ENDPOINT` for
each reel, and ends when its standard input is closed.
"""

import contextlib
import sys

from estune.remote import zenoh
from plants.bench.cable_platform.examples import EXAMPLES
from plants.bench.cable_platform.real_time import RealTimePlatform


def main(name: str = "platform") -> int:
    """Serves the reels of an example; returns the exit code."""
    if name not in EXAMPLES:
        sys.exit(f"there is no example {name!r}; name one of {', '.join(EXAMPLES)}")
    mechanism, names = EXAMPLES[name]()
    with contextlib.ExitStack() as stack:
        platform = stack.enter_context(RealTimePlatform(mechanism))
        for number, rig in enumerate(names):
            server = stack.enter_context(zenoh.serve(platform.reel(number, rig)))
            print(f"rig {rig} at {server.endpoint}", flush=True)
        sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
