"""The procedure: tune every reel, choose the level, bring every reel to it, repeat to show it.

A cost is comparable between reels only where it asks the same of them: one step and one settling
time t_s for all, by default the longest that any of the rigs suggests.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from estune.core.cost import StepCost
from estune.errors import InvalidInput, RigError
from estune.run.loop import ProgressListener
from estune.run.plan import MOVE_WEIGHT
from estune.run.targets import is_endpoint
from estune.studies.match.outcome import Matching
from estune.studies.match.reel_matcher import ReelMatcher, ReelProgress, Settings, Told
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile

if TYPE_CHECKING:
    from estune.remote.security import Security

FOLDER = "matches"
"""Folder that matchings are kept in, below the one estune is called from."""

Auto = Literal["auto"]


def match(
    targets: Mapping[str, Any] | Sequence[Any],
    *,
    eta: float | Auto = "auto",
    settings: Settings | None = None,
    step: StepProfile | None = None,
    cost: StepCost | None = None,
    folder: str | Path | None = None,
    journal: bool = True,
    apply: bool = False,
    security: "Security | None" = None,
    watch: ProgressListener | Literal["auto"] | None = None,
    tell: Told = lambda _: None,
) -> Matching:
    """Tunes several reels to one cost.

    A reel that cannot be reached, tuned or brought to the target has a record that says why, and
    the others go on. A matching that was cut off goes on with the same call and folder.

    Args:
        targets: The reels: endpoints, plants or rigs as `estune.tune` takes them, or those by
            label.
        eta: The cost aimed at; "auto" is what all can reach: the upper end of the 95 % interval of
            the worst tuned reel's cost.
        settings: How; by default as `Settings` has it.
        step: The step trial for all reels; by default the one the first rig suggests.
        cost: How trials are scored on all reels; by default (35) with a move penalty and the
            longest settling time a rig suggests.
        folder: Where this matching is kept; by default matches/TIME.
        journal: Whether to keep the runs on disk.
        apply: Whether to make the matched gains of reels that pass their rigs' live ones.
        security: Who this is, where a rig asks.
        watch: Told of each trial; "auto" shows progress, None nothing.
        tell: Told in a line what is done next.

    Raises:
        InvalidInput: eta is not above zero, "auto" has fewer than two reels to go by, a label is
            given twice, or the folder holds a matching with other settings.
        RigError: no reel could be reached, or too few could be tuned for "auto".
        Stopped: interrupted (a KeyboardInterrupt); the rig is back at its live gains.

    Example:
        >>> import estune, plants
        >>> stiff, soft = plants.reference_reel(), plants.reference_reel(cable_EA_N=8e3)
        >>> found = estune.match({"a": stiff, "b": soft}, journal=False)
        >>> found.passed
        True
    """
    named = _labelled(targets)
    if eta == "auto":
        if len(named) < 2:
            raise InvalidInput("eta auto takes the worst of several reels; give one reel an eta")
    elif not (math.isfinite(eta) and eta > 0.0):
        raise InvalidInput(f"eta is {eta}; it must be finite and above zero, or auto")
    where = _folder(folder) if journal else None
    if where is not None:
        tell(f"kept in {where}; if it is cut off, say the same with that folder to go on")
    stages = ReelMatcher(
        settings=settings or Settings(),
        folder=where,
        security=security,
        watch=watch,
        tell=tell,
    )
    reels = [stages.reached(label, target) for label, target in named.items()]
    known = [reel.about for reel in reels if reel.about]
    if len(known) < (2 if eta == "auto" else 1):
        reasons = "; ".join(f"{r.record.label}: {r.record.reason}" for r in reels if r.lost)
        raise RigError(f"too few reels for eta {eta} could be reached ({reasons})")
    common = common_suggestion(known)
    step = step or common.step
    cost = cost or StepCost(common.settling_time_s, move_weight=MOVE_WEIGHT)
    reels = [stages.tuned(reel, step, cost) for reel in reels]
    level = _worst(reels) if eta == "auto" else eta
    reels = [stages.matched(reel, level, step, cost) for reel in reels]
    if apply:
        reels = [stages.applied(reel) for reel in reels]
    records = tuple(reel.record for reel in reels)
    return Matching(
        *(level, eta == "auto", stages.settings.tolerance, step, cost, records, stages.folder)
    )


def common_suggestion(known: Sequence[RigDescription]) -> RigDescription:
    """What several rigs suggest together: the first one's step, the longest settling time."""
    return replace(known[0], settling_time_s=max(about.settling_time_s for about in known))


def _worst(reels: Sequence[ReelProgress]) -> float:
    """The cost all tuned reels can reach: the worst one's, with its uncertainty."""
    highs = [
        reel.record.tuned_level.high for reel in reels if reel.record.tuned_level and not reel.lost
    ]
    highs = [high for high in highs if math.isfinite(high)]
    if len(highs) < 2:
        reasons = "; ".join(f"{r.record.label}: {r.record.reason}" for r in reels if r.lost)
        raise RigError(
            f"eta auto takes the worst of several tuned reels, and {len(highs)} could be tuned "
            f"({reasons}); mend them, or give an eta"
        )
    return max(highs)


def _labelled(targets: Mapping[str, Any] | Sequence[Any]) -> dict[str, Any]:
    """The targets by label; without labels they are numbered."""
    if isinstance(targets, Mapping):
        named = {str(label): target for label, target in targets.items()}
    else:
        if isinstance(targets, str):
            raise InvalidInput(f"give a list of targets, not the text {targets!r}")
        named = {f"reel{n}": target for n, target in enumerate(targets, 1)}
    if not named:
        raise InvalidInput("there is no reel to match; give at least one target")
    endpoints = [target for target in named.values() if is_endpoint(target)]
    if len(set(endpoints)) < len(endpoints):
        raise InvalidInput(
            f"endpoints {', '.join(endpoints)}: one rig is given twice; leave one out"
        )
    for label in named:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", label):
            raise InvalidInput(f"label {label!r} may hold only letters, digits, - and _")
    return named


def _folder(folder: str | Path | None) -> Path:
    if folder is not None:
        return Path(folder)
    return Path(FOLDER) / datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
