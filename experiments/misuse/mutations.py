"""Texts and messages changed at random."""

import re
from collections.abc import Sequence
from random import Random

EXTREMES = (
    *("NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1e308", "5e-324", "-0.0", "0"),
    *("9223372036854775808", "1" * 400, "true", "null", '"1"', "[]", "{}", "-1", "0.5"),
)
"""Values of JSON in place of what is expected."""

_VALUE = re.compile(rb'(?<=[:=])( ?-?\d[\d.eE+_-]*| ?"[^"]*"| ?true| ?false|null)')


def mutated(random: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """The bytes with one to four changes.

    Args:
        random: Source of the changes.
        data: The bytes.
        others: What pieces may come from.
    """
    for _ in range(random.randint(1, 4)):
        at, to = sorted((random.randint(0, len(data)), random.randint(0, len(data))))
        piece = data[at:to]
        match random.randrange(8):
            case 0 if data:
                place = random.randrange(len(data))
                flipped = data[place] ^ 1 << random.randrange(8)
                data = data[:place] + bytes([flipped]) + data[place + 1 :]
            case 1 if data:
                place = random.randrange(len(data))
                data = data[:place] + random.randbytes(1) + data[place + 1 :]
            case 2:
                data = data[:at] + data[to:]
            case 3:
                data = data[:to] + piece + data[to:]
            case 4:
                data = data[:at]
            case 5:
                data = data[:at] + random.randbytes(random.randint(1, 8)) + data[at:]
            case 6:
                data = data[:at] + random.choice(others)[at:to] + data[to:]
            case _:
                data = with_extreme(random, data)
    return data


def with_extreme(random: Random, data: bytes) -> bytes:
    """One value of a JSON or TOML text made extreme."""
    values = list(_VALUE.finditer(data))
    if not values:
        return data
    value = random.choice(values)
    return data[: value.start()] + random.choice(EXTREMES).encode() + data[value.end() :]
