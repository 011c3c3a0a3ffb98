"""Threads that keep a board up to date."""

import logging
import threading

from estune.errors import EstuneError
from estune.web.board import Board

_END_WITHIN_S = 2.0
_AGAIN_S = 1.0

_log = logging.getLogger(__name__)


class Reader:
    """A source that is read at intervals by a thread of its own; derive and define `read`.

    What goes wrong is shown on the board under `fault.<source>`, and the source is read again.

    Attributes:
        source: Name of the source on the board.
        every_s: Interval, s.
    """

    source = ""
    every_s = 0.2

    def __init__(self, board: Board) -> None:
        self.board = board
        self.ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name=self.source, daemon=True)

    def start(self) -> None:
        """Begins to read."""
        self._thread.start()

    def read(self) -> None:
        """Reads the source once."""
        raise NotImplementedError

    def release(self) -> None:
        """Closes what the source has open; called from the thread itself."""

    def close(self) -> None:
        """Ends the thread."""
        self.ended.set()
        if self._thread.is_alive():
            self._thread.join(_END_WITHIN_S)

    def _work(self) -> None:
        pause_s = 0.0
        while not self.ended.wait(pause_s):
            try:
                self.read()
            except EstuneError as error:
                self._fail(str(error))
                pause_s = _AGAIN_S
            except Exception as error:  # noqa: BLE001  the page says so, and the source is read again
                _log.exception("%s cannot be shown", self.source)
                self._fail(f"{type(error).__name__}: {error}")
                pause_s = _AGAIN_S
            else:
                self.board.put(f"fault.{self.source}", "")
                self.board.mark_heard(self.source)
                pause_s = self.every_s
        self.release()

    def _fail(self, sentence: str) -> None:
        self.board.put(f"fault.{self.source}", sentence)
        self.release()
