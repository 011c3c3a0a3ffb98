"""Further processes on the network: a router, a second client, a slow consumer.

python -m experiments.chaos.others router|rival|slow ENDPOINT [NAME]
"""

import json
import sys
import threading
from collections.abc import Callable

import zenoh

from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.remote import messages
from estune.remote.zenoh import connect
from estune.remote.zenoh.zenoh_session import open_session
from estune.trial import TrialRequest
from experiments.chaos.processes import ready

GENTLE = Gains(0.2, 6.0, 0.005, 0.05)
QUERIES = 300


def router(endpoint: str) -> None:
    """Routes until killed."""
    closed = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    config = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": closed,
        "transport": {"shared_memory": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))):
        print("routing", flush=True)
        threading.Event().wait()


def rival(endpoint: str, name: str) -> None:
    """Submits a trial of its own."""
    with connect(endpoint) as rig:
        print(rig.run(TrialRequest(name, 0, GENTLE, rig.describe().step)).outcome, flush=True)


def slow(endpoint: str) -> None:
    """Queries more than it receives, until killed."""
    keys = messages.Keys("reel")
    with open_session("client", connect=(endpoint,), message_max_bytes=2**24) as session:
        subscribers = [
            session.declare_subscriber(key, zenoh.handlers.FifoChannel(1))
            for key in (keys.status, keys.telemetry("*"))
        ]
        print("asking", flush=True)
        while subscribers:
            waiting = [session.get(keys.describe, timeout=2.0) for _ in range(QUERIES)]
            next(iter(waiting[-1]), None)


if __name__ == "__main__":
    parts: dict[str, Callable[..., None]] = {"router": router, "rival": rival, "slow": slow}
    ready()
    try:
        parts[sys.argv[1]](*sys.argv[2:])
    except (EstuneError, zenoh.ZError) as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        pass
