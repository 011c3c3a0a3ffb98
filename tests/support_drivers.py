"""A driver of the emulated reel some of whose readings do not come; loaded by the loop itself."""

from estune.hardware.driver import Position
from plants.emulator import EmulatedDriver


class StallingDriver(EmulatedDriver):
    """Readings that do not come: from one on, so many in a row."""

    def __init__(self, address, stall_at, stalled):
        super().__init__(address)
        self._stalled = range(stall_at, stall_at + stalled)
        self._number = 0

    def read(self):
        self._number += 1
        if self._number in self._stalled:
            raise TimeoutError(f"reading {self._number} did not come")
        return super().read()


class StillDrive:
    """A drive that never turns, beside which a gauge is tested."""

    def enable(self):
        pass

    disable = safe_state = request = close = enable

    def write(self, current_counts):
        pass

    def position(self):
        return Position(0)
