"""Comparison of tuners on one plant or rig, each with the same start, step, cost and budget."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from estune import api
from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput
from estune.loop_model.optimum import RobustnessLimits
from estune.run.behaviour import LoopBehaviour
from estune.run.ending import RunEnding
from estune.run.journal import FILE_NAME
from estune.run.loop import ProgressListener
from estune.run.plan import TOLERANCE, TRIALS
from estune.run.results.result import TuneResult
from estune.tuners import tuner_class

if TYPE_CHECKING:
    import pandas as pd

COMPARED = ("model_based", "safe_bayesian", "least_squares_gradient", "otis")
"""Tuners that are compared where none are named."""

BEHAVIOUR = ("tracking_N", "reversal_N", "rest_N")
"""Columns of a comparison with the three numbers of a `LoopBehaviour`."""

COMPARISONS = "comparisons"
"""Default folder of comparisons, in the working directory."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison:
    """Results by tuner, the best that may be used first."""

    results: Mapping[str, TuneResult]
    folder: Path

    def to_frame(self) -> "pd.DataFrame":
        """One row for each tuner."""
        import pandas as pd  # noqa: PLC0415  slow to import

        return pd.DataFrame([_row(name, r) for name, r in self.results.items()])

    def __repr__(self) -> str:
        return str(self.to_frame().to_string(index=False))

    def _repr_html_(self) -> str:
        return str(self.to_frame().to_html(index=False))

    def to_json(self) -> dict[str, Any]:
        """The rows by tuner as JSON values, with cost and lowest cost so far of each trial."""
        return {
            name: {
                **_row(name, result),
                "message": result.message,
                "limits": "" if result.limits is None else result.limits.reason,
                "costs": searched(result)["cost"].tolist(),
                "best_costs": searched(result)["best_cost"].tolist(),
            }
            for name, result in self.results.items()
        }


def compare(
    target: Any,
    tuners: Sequence[str] = COMPARED,
    *,
    trials: int = TRIALS,
    tolerance: float = TOLERANCE,
    limits: RobustnessLimits | None = None,
    folder: str | Path | None = None,
    watch: ProgressListener | Literal["auto"] | None = "auto",
    **how: Any,
) -> Comparison:
    """Tunes one target by several tuners, one after the other.

    On a rig the tuners follow each other in time, so that a drift of the rig falls on them
    unequally. The rig's live gains are restored after each trial and stay the start of all.

    Args:
        target: As in `estune.tune`.
        tuners: Names of tuners.
        trials: Greatest number of search trials of each.
        tolerance: As in `estune.tune`; zero makes each use all its trials.
        limits: Limits of sensitivity and overshoot, by which all results are judged.
        folder: Folder of the comparison, in which a run that was interrupted continues;
            `comparisons/TIME` by default.
        watch: As in `estune.tune`.
        how: Further arguments of `estune.tune`.

    Raises:
        InvalidInput: fewer than two tuners are named, one twice, or there is none of a name.
        Stopped: interrupted (a KeyboardInterrupt); the rig is back at its live gains.
        EstuneError: as of `estune.tune`.

    Example:
        >>> import estune, plants
        >>> both = estune.compare(
        ...     plants.reference_reel(), ["model_based", "otis"], trials=30
        ... )  # doctest: +SKIP
    """
    if len(tuners) < 2 or len(set(tuners)) < len(tuners):
        raise InvalidInput(f"tuners are {', '.join(tuners)}; name at least two, each once")
    for name in tuners:
        tuner_class(name)
    where = Path(folder) if folder else free_folder()
    results: dict[str, TuneResult] = {}
    for name in tuners:
        run = name.replace(":", "-").replace(".", "-")
        if (where / run / FILE_NAME).is_file():
            again = {key: how[key] for key in ("security", "patience_s", "ask") if key in how}
            results[name] = api.resume(where / run, target, watch=watch, **again)
            continue
        fixed = {"trials": trials, "tolerance": tolerance, "limits": limits, "tracking": True}
        chosen: dict[str, Any] = {**fixed, **how}
        results[name] = api.tune(target, tuner=name, run=run, folder=where, watch=watch, **chosen)
    return Comparison(dict(sorted(results.items(), key=lambda item: _rank(item[1]))), where)


def _rank(result: TuneResult) -> tuple[int, float]:
    """Place of a result: by what may be used, then by the cost."""
    usable = (RunEnding.TUNED, RunEnding.LIMITS_NOT_SHOWN, RunEnding.LIMIT_BROKEN)
    place = usable.index(result.ending) if result.ending in usable else len(usable)
    return place, result.fun if math.isfinite(result.fun) else math.inf


def free_folder() -> Path:
    """A folder of the present time."""
    return Path(COMPARISONS) / datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")


def searched(result: TuneResult) -> "pd.DataFrame":
    """The search trials of a run as of `TuneResult.to_frame`, void ones excluded."""
    frame = result.to_frame()
    return frame[
        (frame["phase"] == "search") & ~frame["outcome"].isin(("cancelled", "interrupted"))
    ]


def behaviour_of(result: TuneResult) -> LoopBehaviour:
    """Tracking and rest at the gains to use; NaN where they were not measured."""
    found = result.behaviour.get("tuned" if result.tuned else "start")
    return found if isinstance(found, LoopBehaviour) else LoopBehaviour(*3 * (math.nan,))


def _row(name: str, result: TuneResult) -> dict[str, Any]:
    at, margins = result.tuned or result.start, result.claim.margins
    return {
        "tuner": name,
        "ending": str(result.ending),
        "search_trials": result.nit,
        "trials": result.nfev,
        "unsafe": result.unsafe,
        "start_cost": result.verdict.start_cost,
        "cost": result.fun,
        "overshoot": math.nan if at.metrics is None else at.metrics.overshoot,
        "sensitivity": math.nan if margins is None else margins.sensitivity.value,
        **dict(zip(BEHAVIOUR, behaviour_of(result), strict=True)),
        **dict(zip(GAIN_NAMES, result.gains.as_tuple(), strict=True)),
    }
