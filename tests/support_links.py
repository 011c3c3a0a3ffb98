"""A wire between two sockets that can be cut, for tests of what a link survives."""

import contextlib
import socket
import threading
from typing import Self


class Wire:
    """Passes bytes between its own endpoint and another. A context manager."""

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.removeprefix("tcp/").split(":")
        self._target = host, int(port)
        self._ends: list[socket.socket] = []
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._closed = False
        self._lose = threading.Event()
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def cut(self) -> None:
        """Breaks every connection; new ones are let through."""
        with self._lock:
            ends, self._ends = self._ends, []
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def lose_next_answer(self) -> None:
        """Breaks every connection the moment the other side says something, and loses that."""
        self._lose.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._threads[0].join()
        self.cut()
        for thread in self._threads:
            thread.join()

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
            for source, sink, answers in ((near, far, False), (far, near, True)):
                passing = threading.Thread(target=self._pass, args=(source, sink, answers))
                self._threads.append(passing)
                passing.start()

    def _pass(self, source: socket.socket, sink: socket.socket, answers: bool) -> None:  # noqa: FBT001  called by Thread
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                if answers and self._lose.is_set():
                    self._lose.clear()
                    self.cut()
                    break
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        source.close()
