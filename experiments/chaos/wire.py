"""A TCP proxy that can be cut, stalled, and made to lose a reply."""

import contextlib
import socket
import threading
from typing import Literal, Self

Way = Literal["both", "there", "back"]
CHUNK_BYTES = 65536


class Wire:
    """Passes bytes between its own endpoint and another. A context manager.

    Attributes:
        endpoint: Where it listens.
    """

    def __init__(self, target: str) -> None:
        """`target` need not listen yet: earlier connections are refused."""
        host, port = target.removeprefix("tcp/").split(":")
        self._target = host, int(port)
        self._ends: list[socket.socket] = []
        self._lock = threading.Lock()
        self._flowing = {"there": threading.Event(), "back": threading.Event()}
        self.flow()
        self._lose = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._closed = False
        self._accepting = threading.Thread(target=self._accept, daemon=True)
        self._accepting.start()

    def cut(self) -> None:
        """Breaks every connection; new ones are accepted."""
        with self._lock:
            ends, self._ends = self._ends, []
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def stall(self, way: Way = "both") -> None:
        """Holds all bytes back that way; connections stay."""
        for name, event in self._flowing.items():
            if way in ("both", name):
                event.clear()

    def flow(self) -> None:
        """Passes all bytes again."""
        for event in self._flowing.values():
            event.set()

    def lose_next_answer(self) -> None:
        """Breaks every connection at the next bytes of the target, and loses these."""
        self._lose.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._accepting.join()
        self.flow()
        self.cut()

    def _accept(self) -> None:
        while not self._closed:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                far = socket.create_connection(self._target)
            except OSError:
                near.close()
                continue
            with self._lock:
                self._ends += [near, far]
            for source, sink, way in ((near, far, "there"), (far, near, "back")):
                threading.Thread(target=self._pass, args=(source, sink, way), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket, way: str) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(CHUNK_BYTES):
                self._flowing[way].wait()
                if way == "back" and self._lose.is_set():
                    self._lose.clear()
                    self.cut()
                    break
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        source.close()
