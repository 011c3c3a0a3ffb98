"""Threads that keep a board up to date."""

import logging
import math
import threading
import time

from estune.errors import EstuneError
from estune.web.board import Board

_END_WITHIN_S = 2.0
_AGAIN_S = 1.0
"""Time until a source that failed is read again, s: at its own rate the log would fill."""
LINGER_S = 5.0
"""Time for which a source without a page is still read, s; pages ask for the list each 3 s."""

_log = logging.getLogger(__name__)


class Reader:
    """A source that a thread reads at intervals while a page shows it; derive and define `read`.

    What goes wrong is shown on the board under `fault.<source>`, and the source is read again.
    """

    source = ""
    every_s = 0.2

    def __init__(self, board: Board) -> None:
        self.board = board
        self._ended = False
        self._looked_at_s = -math.inf
        self._wake = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._work, name=self.source, daemon=True)

    def look(self) -> None:
        """Notes that a page shows the source now: it is read for `LINGER_S` more."""
        with self._lock:
            was_shown = self.is_shown
            self._looked_at_s = time.monotonic()
            if self._thread.ident is None and not self._ended:
                self._thread.start()
            elif not was_shown:
                self._wake.set()

    @property
    def is_shown(self) -> bool:
        """Whether a page has shown the source of late."""
        return time.monotonic() - self._looked_at_s < LINGER_S

    def read(self) -> None:
        """Reads the source once."""
        raise NotImplementedError

    def release(self) -> None:
        """Closes what the source has open; called from the thread itself."""

    def end(self) -> None:
        """Has the thread end."""
        with self._lock:
            self._ended = True
            self._wake.set()

    def close(self) -> None:
        """Ends the thread, and waits for that."""
        self.end()
        if self._thread.is_alive():
            self._thread.join(_END_WITHIN_S)

    def _work(self) -> None:
        while not self._ended:
            self._wake.clear()
            if self.is_shown:
                self._wake.wait(self._read_once())
            else:
                self.release()
                self._wake.wait()
        self.release()

    def _read_once(self) -> float:
        """Reads the source; returns the time until the next reading, s."""
        try:
            self.read()
        except EstuneError as error:
            self._fail(str(error))
            return _AGAIN_S
        except Exception as error:  # noqa: BLE001  the page says so, and the source is read again
            _log.exception("%s cannot be shown", self.source)
            self._fail(f"{type(error).__name__}: {error}")
            return _AGAIN_S
        self.board.put(f"fault.{self.source}", "")
        self.board.mark_heard(self.source)
        return self.every_s

    def _fail(self, sentence: str) -> None:
        self.board.put(f"fault.{self.source}", sentence)
        self.release()
