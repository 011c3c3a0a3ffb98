"""State of the model-based search."""

from typing import Any, NamedTuple

from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.records import LoopRecord
from estune.tuners.interface import ConvergenceEstimate
from estune.tuners.predictions import ComparedTrial
from estune.tuners.residual_surface import ResidualSurface
from estune.tuners.search_space import Coordinates, Point


class IdentifiedLoopState(NamedTuple):
    """The state of a model-based search.

    Attributes:
        base: Coordinates of the safe trial of least cost by the model, about which the search
            reaches.
        best_point: The point of the best safe trial.
        records: Last records of the loop in step trials.
        excitations: Records of its excitations, of those that are fitted.
        trials: All safe trials with a record, of which more are known than are fitted.
        fit: The identified loop; None before the first record.
        surface: What the last trials measured beyond its predictions; None where these stand.
        caution: Logarithm of the predicted cost of the centre over that of the optimum without a
            margin to the limits; None where it is not known.
        step_scale: Factor on the reach after unsafe trials.
        fallen_back: Whether the fallback tuner proposes.
    """

    fallback: Any
    proposal: Point
    centre: Coordinates
    base: Coordinates
    best_point: Point
    best_cost: float | None = None
    records: tuple[LoopRecord, ...] = ()
    excitations: tuple[LoopRecord, ...] = ()
    trials: tuple[ComparedTrial, ...] = ()
    fit: LoopFit | None = None
    surface: ResidualSurface | None = None
    caution: float | None = None
    step_scale: float = 1.0
    estimate: ConvergenceEstimate | None = None
    fallen_back: bool = False


def fit_of(state: object) -> LoopFit | None:
    """The identified loop of a tuner's state; None where the tuner identifies none."""
    return state.fit if isinstance(state, IdentifiedLoopState) else None
