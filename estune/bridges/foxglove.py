"""A rig in Foxglove and Lichtblick, by a WebSocket server of Foxglove's own library."""

import ipaddress
from contextlib import suppress
from typing import Self

from estune.bridges.viewer import ViewedRig, ViewedSample
from estune.errors import InvalidInput

ADDRESS = "127.0.0.1:8765"
_SAMPLE = {
    "type": "object",
    "properties": {name: {"type": "number"} for name in ViewedSample._fields[1:]},
}


class FoxgloveViewer:
    """Serves topics `/RIG/samples` and `/RIG/state`; implements `Viewer`. A context manager.

    Clients can only look: the server offers them nothing to publish, call or set.

    Args:
        at: Loopback address and port of the server; port 0 takes a free one.

    Raises:
        InvalidInput: the library is missing, or the address cannot be served at.
    """

    def __init__(self, rig: str, at: str = ADDRESS) -> None:
        try:
            import foxglove  # noqa: PLC0415  an extra
        except ImportError as error:
            raise InvalidInput("foxglove needs: pip install estune[foxglove]") from error
        host, _, port = at.rpartition(":")
        if not (port.isdecimal() and _is_loopback(host)):
            raise InvalidInput(f"{at!r}: give a loopback address and port, such as {ADDRESS}")
        self._context = foxglove.Context()  # its channels close with it
        try:
            self._server = foxglove.start_server(
                name=f"estune: {rig}", host=host, port=int(port), context=self._context
            )
        except (RuntimeError, OverflowError) as error:
            raise InvalidInput(f"cannot serve at {at}: {error}; give another --to") from error
        self.address = f"{host}:{self._server.port}"
        self._samples = foxglove.Channel(f"/{rig}/samples", schema=_SAMPLE, context=self._context)
        self._state = foxglove.Channel(f"/{rig}/state", context=self._context)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    def show_samples(self, samples: list[ViewedSample]) -> None:
        """Sends each sample to the clients that have subscribed."""
        for sample in samples:
            self._samples.log(sample.values(), log_time=sample.time_ns)

    def show_state(self, state: ViewedRig) -> None:
        """Sends the status and the live gains."""
        self._state.log(state.values(), log_time=state.time_ns)


def _is_loopback(host: str) -> bool:
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False
