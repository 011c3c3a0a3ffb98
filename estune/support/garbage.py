"""Garbage collection while many values are made at once."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collection_paused() -> Iterator[None]:
    """A block that makes many values without cycles, and whose garbage waits until its end.

    The collector visits all values again and again while they grow in number: 100 000 trials of a
    journal are read in 0.20 s without it and in 0.36 s with it, and the source of the product is
    parsed in 0.6 s for 2.3 s.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
