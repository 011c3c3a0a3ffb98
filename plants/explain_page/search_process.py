"""`estune explain` in a process of its own, with its progress."""

import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estune.errors import InvalidInput

_PROGRESS = re.compile(r"^\s*(\d+) of 100 %\s+(?:[\d:-]+ left\s+)?(.*)$")
_END_WITHIN_S = 5.0


class SearchProcess:
    """One search at a time; any thread may ask."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None
        self._percent, self._phase = 0, ""
        self._said: list[str] = []
        self._stopped = False

    def begin(self, options: Sequence[str], result: Path) -> None:
        """Begins a search whose JSON goes into a file.

        Raises:
            InvalidInput: one is under way.
        """
        if self._process is not None and self._process.poll() is None:
            raise InvalidInput("a search is under way; stop it first")
        self._percent, self._phase, self._said, self._stopped = 0, "starting", [], False
        command = [sys.executable, "-P", "-m", "estune", "explain", *options]
        # JSON for the page, progress for its bar.
        with result.open("w", encoding="utf-8") as out:
            self._process = subprocess.Popen(  # noqa: S603  our own interpreter and module
                [*command, "--json"], stdout=out, stderr=subprocess.PIPE, text=True
            )
        self._reader = threading.Thread(target=self._follow, args=(self._process,), daemon=True)
        self._reader.start()

    def stop(self) -> None:
        """Stops the search; nothing happens without one."""
        process = self._process
        if process is not None and process.poll() is None:
            self._stopped = True
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_END_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if self._reader is not None:
                self._reader.join()

    def state(self) -> dict[str, Any]:
        """State in a word, progress in per cent, its phase, and why the search failed."""
        process = self._process
        if process is None:
            return {"state": "none"}
        code = process.poll()
        if code is None:
            return {"state": "running", "percent": self._percent, "phase": self._phase}
        if self._reader is not None:  # it closes the pipe
            self._reader.join()
        if self._stopped:
            return {"state": "stopped"}
        if code in DONE:
            return {"state": "done"}
        said = " ".join(self._said[-3:]) or f"the search ended with code {code}"
        return {"state": "failed", "reason": said}

    def _follow(self, process: "subprocess.Popen[str]") -> None:
        assert process.stderr is not None  # noqa: S101  a pipe
        with process.stderr as lines:
            for line in lines:
                found = _PROGRESS.match(line)
                if found:
                    self._percent, self._phase = int(found[1]), found[2].strip()
                elif line.strip():
                    self._said.append(line.strip())


DONE = (0, 9, 10)
"""Exit codes of `estune explain` with a verdict; the others are failures."""
