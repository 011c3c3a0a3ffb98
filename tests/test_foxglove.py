"""The bridge to Foxglove's viewer, over a WebSocket of its own."""

import itertools
import json
import socket
import struct
import threading
from contextlib import closing, contextmanager

import pytest

from estune.bridges.foxglove import FoxgloveViewer
from estune.bridges.viewer import ViewedSample
from estune.errors import InvalidInput
from tests.test_bridges import NS, WITHIN_s, state


class WebSocket:
    """Client of a WebSocket (RFC 6455), for unfragmented messages of the server."""

    def __init__(self, address, protocol):
        host, port = address.split(":")
        self._socket = socket.create_connection((host, int(port)), WITHIN_s)
        self._file = self._socket.makefile("rb")
        key = "dGhlIHNhbXBsZSBub25jZQ=="
        lines = ["GET / HTTP/1.1", f"Host: {address}", "Upgrade: websocket", "Connection: Upgrade"]
        lines += ["Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}"]
        lines += [f"Sec-WebSocket-Protocol: {protocol}", "", ""]
        self._socket.sendall("\r\n".join(lines).encode())
        answer = list(iter(self._file.readline, b"\r\n"))
        assert b" 101 " in answer[0]
        # The accept key of the example in section 1.3.
        assert any(b"s3pPLMBiTxaQ9kYGzzhZRbK+xOo=" in line for line in answer)

    def send(self, text):
        data, mask = text.encode(), b"\1\2\3\4"
        assert len(data) < 126
        masked = bytes(byte ^ mask[n % 4] for n, byte in enumerate(data))
        self._socket.sendall(bytes([0x81, 0x80 | len(data)]) + mask + masked)

    def receive(self):
        """Opcode and data of the next message."""
        begin, size = self._file.read(2)
        if size >= 126:
            size = int.from_bytes(self._file.read(2 if size == 126 else 8), "big")
        return begin & 0xF, self._file.read(size)

    def close(self):
        self._file.close()
        self._socket.close()


@contextmanager
def shown_again_and_again(viewer):
    """Samples and a state, shown by a thread."""
    over = threading.Event()

    def show():
        for n in itertools.count():
            viewer.show_samples([ViewedSample(NS + n, 10.0, 9.5 + n, 0.5, -0.2)])
            viewer.show_state(state("smoke"))
            if over.wait(0.01):
                return

    thread = threading.Thread(target=show)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def test_foxglove_server_sends_samples_and_state_and_takes_nothing():
    pytest.importorskip("foxglove")
    with (
        FoxgloveViewer("reel", "127.0.0.1:0") as viewer,
        shown_again_and_again(viewer),  # what came before the subscription is not sent
        closing(WebSocket(viewer.address, "foxglove.sdk.v1")) as client,
    ):
        info, topics = {}, {}
        while len(topics) < 2:
            _, data = client.receive()
            message = json.loads(data)
            if message["op"] == "serverInfo":
                info = message
            for channel in message.get("channels", ()):
                topics[channel["topic"]] = channel["id"]
        # A server without these takes nothing from its clients.
        assert not {"clientPublish", "parameters", "services"} & set(info["capabilities"])
        assert set(topics) == {"/reel/samples", "/reel/state"}
        wanted = [{"id": n, "channelId": topics[t]} for n, t in enumerate(sorted(topics))]
        client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        found = {0: [], 1: []}
        while not all(found.values()):
            opcode, data = client.receive()
            if opcode == 2:
                _, subscription, time_ns = struct.unpack_from("<BIQ", data)
                found[subscription].append((time_ns, json.loads(data[13:])))
    time_ns, sample = found[0][0]
    assert sample == {
        "setpoint_N": 10.0,
        "tension_N": 9.5 + (time_ns - NS),
        "current_A": 0.5,
        "angle_rad": -0.2,
    }
    assert found[1][0] == (NS, state("smoke").values())


@pytest.mark.parametrize("at", ["0.0.0.0:8765", "127.0.0.1:0x", "localhost", "127.0.0.1:99999"])
def test_foxglove_server_refuses_other_machines_and_wrong_addresses(at):
    pytest.importorskip("foxglove")
    with pytest.raises(InvalidInput, match=r"127\.0\.0\.1:8765|another --to"):
        FoxgloveViewer("reel", at)
