"""Time of the emulated machine: that of the computer, except where the computer is held up."""

from types import SimpleNamespace

import pytest

from plants.emulator import clock
from plants.emulator.clock import MachineClock

PERIOD_s = 1.0 / 632.0


class Computer:
    """A clock that the test moves."""

    def __init__(self, monkeypatch):
        self.time_s = 0.0
        monkeypatch.setattr(clock, "time", SimpleNamespace(monotonic=lambda: self.time_s))

    def readings(self, machine: MachineClock, number: int, interval_s: float) -> list[float]:
        """The machine's times of so many readings."""
        stamps = []
        for _ in range(number):
            self.time_s += interval_s
            stamps.append(machine.now_s(reading=True))
        return stamps


@pytest.fixture
def computer(monkeypatch):
    return Computer(monkeypatch)


@pytest.mark.parametrize("late", [0.1, 0.25])
def test_machine_in_time_has_the_clock_of_the_computer(computer, late):
    machine = MachineClock(1.0)
    stamp_s = computer.readings(machine, 500, PERIOD_s)[-1]
    behind_s = computer.time_s - stamp_s
    for _ in range(1000):
        computer.readings(machine, 1, (1.0 + late) * PERIOD_s)
        computer.readings(machine, 1, (1.0 - late) * PERIOD_s)
    assert computer.time_s - machine.now_s() == pytest.approx(behind_s)


def test_machine_waits_for_a_computer_that_is_held_up(computer):
    machine = MachineClock(1.0)
    before = computer.readings(machine, 500, PERIOD_s)[-1]
    after = computer.readings(machine, 1, 0.075)[0]
    assert PERIOD_s < after - before < 1.5 * PERIOD_s
    following = computer.readings(machine, 2, PERIOD_s)
    assert following[0] - after == pytest.approx(PERIOD_s)


def test_machine_goes_on_without_a_loop_that_hangs(computer):
    machine = MachineClock(1.0)
    computer.readings(machine, 500, PERIOD_s)
    computer.time_s += 0.9
    stands = machine.now_s()
    assert computer.time_s - stands > 0.85
    computer.time_s += 0.2
    assert machine.now_s() == pytest.approx(computer.time_s)


def test_real_hardware_waits_for_nobody(computer):
    machine = MachineClock(0.0)
    computer.readings(machine, 500, PERIOD_s)
    computer.time_s += 0.075
    assert machine.now_s() == computer.time_s


def test_machine_follows_a_slower_loop(computer):
    machine = MachineClock(1.0)
    computer.readings(machine, 500, PERIOD_s)
    computer.readings(machine, 200, 4.0 * PERIOD_s)
    stamps = computer.readings(machine, 2, 4.0 * PERIOD_s)
    assert stamps[1] - stamps[0] == pytest.approx(4.0 * PERIOD_s)
