"""A rig in PlotJuggler, by UDP datagrams of JSON."""

import json
import socket
from contextlib import suppress
from typing import Any, Self

from estune.bridges.viewer import ViewedRig, ViewedSample
from estune.errors import InvalidInput

ADDRESS = "127.0.0.1:9870"
"""Address at which PlotJuggler's UDP server listens by default."""


class PlotJuggler:
    """Sends each sample, and the status; implements `Viewer`. A context manager.

    In PlotJuggler: UDP server, protocol JSON, "use field as timestamp" with `timestamp`.

    Args:
        rig: The rig's name, under which its series are listed.
        to: Address and port, such as 127.0.0.1:9870.

    Raises:
        InvalidInput: there is no such address.
    """

    def __init__(self, rig: str, to: str = ADDRESS) -> None:
        host, _, port = to.rpartition(":")
        try:
            found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)[0]
        except (OSError, ValueError, OverflowError) as error:
            raise InvalidInput(f"{to!r} is no HOST:PORT ({error}); such as {ADDRESS}") from error
        self._rig, self._to = rig, found[4]
        self._socket = socket.socket(found[0], socket.SOCK_DGRAM)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def show_samples(self, samples: list[ViewedSample]) -> None:
        """Sends a datagram for each sample."""
        for sample in samples:
            self._send(sample.time_ns, sample.values())

    def show_state(self, state: ViewedRig) -> None:
        """Sends the status and the live gains."""
        self._send(state.time_ns, state.values())

    def _send(self, time_ns: int, values: dict[str, Any]) -> None:
        data = json.dumps({"timestamp": 1e-9 * time_ns, self._rig: values}).encode()
        with suppress(OSError):  # nobody listens yet, or no network for a moment
            self._socket.sendto(data, self._to)
