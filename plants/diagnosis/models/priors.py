"""What is known of a model's numbers before any record: how far a fit may move them for little."""

from collections.abc import Mapping
from typing import Any

INERTIA_sd = 0.3
"""Standard deviation of the logarithm of an inertia or mass that nobody states better: reckoned
from drawings or a data sheet. Without it an inertia of a motor bench moved by a factor of 4.3 to
make up for dry friction; with 0.2 and 0.4 it stayed within 9 %. Other numbers have none unless
their owner states one: a prior on viscous friction makes dry friction of a wrong viscous one."""
DRY_MASS = "drum_inertia_kg_m2"


def stated(model: Any) -> Mapping[str, float]:
    """Standard deviations of the logarithm of a model's own numbers, by field."""
    return {DRY_MASS: INERTIA_sd, **dict(getattr(model, "uncertainty", ()))}
