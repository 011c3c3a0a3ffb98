"""Checks of a rig that is not served yet, by its file: the driver, then the loop around it."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from estune.cli.checks import description_checks, driver_checks, trial_checks
from estune.cli.checks.check_result import CheckResult, State, unknown
from estune.cli.checks.run_checks import FAILED, MOVE, check_in_motion

if TYPE_CHECKING:
    from estune.hardware import RigConfig

SECONDS = 2.0
"""Length of the measurement of the driver: 1264 readings at 632 Hz."""


def run_file_checks(
    config: "RigConfig", *, move: bool, repeats: int, seconds: float = SECONDS
) -> Iterator[CheckResult]:
    """Checks the hardware of a rig's file; yields each result as soon as it is known.

    Without `move` the amplifier gets no power, and readings are all that is asked for.

    Raises:
        InvalidInput: the driver does not take its settings.
        RigError: the hardware is not reached, or does not answer.
    """
    from estune.hardware import HardwareRig  # noqa: PLC0415  slow to import
    from estune.hardware.trial_board.rig import DRIVER  # noqa: PLC0415  as above

    about = config.describe()
    limits = description_checks.check_limits(about)
    yield limits
    yield description_checks.check_gain_bounds(about)
    if config.driver.use == DRIVER:
        yield unknown(
            "time budget", "the loop is on the board", "serve it, then estune doctor ENDPOINT"
        )
        return
    results = [limits]
    for result in _of_driver(config, seconds):
        results.append(result)
        yield result
    # What a slow exchange does to the loop is bounded by the guard (`gap_s`).
    failed = any(r.state is State.FIX and r.check != "time budget" for r in results)
    if not move:
        yield MOVE
    elif failed:
        yield FAILED
    else:
        with HardwareRig(config) as rig:
            yield from check_in_motion(rig, about, repeats)
            yield driver_checks.check_loop(rig.timing(), config.sampling_Hz)


def _of_driver(config: "RigConfig", seconds: float) -> Iterator[CheckResult]:
    from estune.hardware.driver import load_driver  # noqa: PLC0415  slow to import
    from estune.hardware.exchange_timing import measure_exchanges  # noqa: PLC0415  as above
    from estune.hardware.real_time import prioritised  # noqa: PLC0415  as above

    with (
        load_driver(*config.driver.driver) as driver,
        prioritised(config.real_time.priority),
    ):
        timing = measure_exchanges(driver, config.sampling_Hz, seconds)
    yield driver_checks.check_messages(timing)
    yield driver_checks.check_readings(timing)
    yield driver_checks.check_exchange(timing)
    yield trial_checks.check_gauge_rate([timing.gauge_counts], config.sampling_Hz)
