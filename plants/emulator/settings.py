"""Settings of the emulated hardware: from plain tables to a board."""

from collections.abc import Mapping
from typing import Any

from estune.core.quantities import check_not_negative
from estune.errors import InvalidInput
from plants.effects import Effect, find
from plants.emulator.board import Electronics, EmulatedBoard, FarEnd
from plants.emulator.clock import MachineClock
from plants.models.reel import reference_reel

_KNOWN = {"reel", "effects", "electronics", "far_end", "seed", "waits_s", "device"}


def make_board(settings: Mapping[str, Any], now_s: float) -> EmulatedBoard:
    """The emulated hardware of these settings.

    Args:
        settings: As of `plants.emulator.EmulatedDriver`.
        now_s: Time at which it begins.

    Raises:
        InvalidInput: a setting is unknown or out of its range.
    """
    unknown = set(settings) - _KNOWN
    if unknown:
        raise InvalidInput(f"the emulated hardware has no setting {', '.join(sorted(unknown))}")
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in settings.get("electronics", {}).items()
    }
    try:
        electronics, far_end = Electronics(**given), FarEnd(**settings.get("far_end", {}))
        effects = [_effect(**effect) for effect in settings.get("effects", ())]
    except TypeError as error:
        raise InvalidInput(f"emulated hardware: {error}") from error
    reel = reference_reel(**settings.get("reel", {}))
    for effect in effects:
        reel += effect
    return EmulatedBoard(reel, electronics, settings.get("seed", 0), now_s, far_end)


def make_clock(settings: Mapping[str, Any]) -> MachineClock:
    """The clock of the emulated hardware of these settings.

    Raises:
        InvalidInput: it is to wait for less than no time.
    """
    waits_s = settings.get("waits_s", 0.0)
    check_not_negative("waits_s of the emulated hardware", waits_s, "s")
    return MachineClock(waits_s)


def _effect(name: str, **parameters: float) -> Effect:
    return find(name)(**parameters)
