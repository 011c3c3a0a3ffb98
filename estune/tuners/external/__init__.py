"""Tuners of other libraries, behind the same ask and tell as those in `estune.tuners`.

They are here to be compared with, and for who trusts them: they know nothing of safety. A trial
that is censored is told to them as a bad one; they do not go back to the best safe point, and
grow no more cautious. The libraries come with `pip install estune[peers]`.
"""

import importlib
from typing import Any

from estune.tuners import TUNERS

OUTSIDE = {
    "optuna": "estune.tuners.external.optuna_tpe:OptunaTpe",
    "bobyqa": "estune.tuners.external.bobyqa:Bobyqa",
}
"""Where the tuners are, by name. Each is made from a search space."""


TUNER_NAMES = (*TUNERS, *OUTSIDE)
"""Every tuner that can be asked for by name."""


def tuner_class(name: str) -> Any:
    """The class of a tuner in `TUNER_NAMES`."""
    if name in TUNERS:
        return TUNERS[name]
    module, _, kind = OUTSIDE[name].partition(":")
    return getattr(importlib.import_module(module), kind)
