"""The library call `estune.match`: tunes every reel, chooses the target, matches every reel.

Costs are comparable between reels only for one step and one settling time t_s. By default t_s is
the longest that any of the rigs suggests.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from estune.core.cost import StepCost, default_cost
from estune.errors import InvalidInput, RigError
from estune.run.loop import ProgressListener
from estune.run.planning import suited_step
from estune.run.targets import is_endpoint
from estune.studies.match.outcome import Matching
from estune.studies.match.reel_matcher import ReelMatcher, ReelProgress, Settings
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile

if TYPE_CHECKING:
    from estune.remote.security import Security

FOLDER = "matches"
"""Default folder of matchings, in the current directory."""

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
    patience_s: float | None = None,
    watch: ProgressListener | Literal["auto"] | None = None,
    log: Callable[[str], None] = lambda _: None,
) -> Matching:
    """Tunes several reels to the same cost.

    A reel that cannot be reached, tuned or matched has a record with the reason, and the others go
    on. A matching that was cut off is continued by the same call with its folder.

    Args:
        targets: The reels: endpoints, plants or rigs as `estune.tune` takes them, or those by
            label.
        eta: The target cost; "auto" is what all can reach: the upper end of the 95 % confidence
            interval of the worst tuned reel's cost.
        settings: Settings of the procedure.
        step: The step trial of all reels; by default the one the first rig suggests.
        cost: The cost on all reels; by default (35) with a control-move penalty and the longest
            settling time a rig suggests.
        folder: Folder of this matching; by default matches/TIME.
        journal: Whether to store the runs on disk.
        apply: Whether to make the matched gains of reels that pass live on their rigs.
        security: Credentials, if a rig requires authentication.
        patience_s: How long to wait for a rig to appear, and where it stops
            replying, s; 3 s and 30 s by default.
        watch: Called after each trial; "auto" shows progress, None nothing.
        log: Called with a line of text at each stage.

    Raises:
        InvalidInput: eta is not above zero, "auto" has fewer than two reels to compare, a label is
            given twice, or the folder has a matching with other settings.
        RigError: no reel could be reached, or too few could be tuned for "auto".
        Stopped: interrupted (a KeyboardInterrupt); the rig is back at its live gains.

    Example:
        >>> import estune, plants
        >>> stiff, soft = plants.reference_reel(), plants.reference_reel(cable_EA_N=8e3)
        >>> matching = estune.match({"a": stiff, "b": soft}, journal=False)
        >>> matching.passed
        True
    """
    labelled = _labelled(targets)
    least = 2 if eta == "auto" else 1
    if len(labelled) < least:
        raise InvalidInput("eta auto takes the worst of several reels; give one reel an eta")
    if eta != "auto" and not (math.isfinite(eta) and eta > 0.0):
        raise InvalidInput(f"eta is {eta}; it must be finite and above zero, or auto")
    where = Path(folder or free_folder()) if journal else None
    if where is not None:
        log(f"stored in {where}; to continue after an interruption, give the same folder")
    matcher = ReelMatcher(settings or Settings(), where, security, patience_s, watch, log)
    reels = [matcher.reached(label, target) for label, target in labelled.items()]
    descriptions = [reel.description for reel in reels if reel.description]
    if len(descriptions) < least:
        raise RigError(f"too few reels for eta {eta} could be reached ({_reasons(reels)})")
    common = common_description(descriptions)
    step = step or common.step
    cost = cost or default_cost(common.settling_time_s).scaled(common.effort_scale or 1.0)
    step = suited_step(step, cost, common)
    reels = [matcher.tuned(reel, step, cost) for reel in reels]
    target = _worst(reels) if eta == "auto" else eta
    reels = [matcher.matched(reel, target, step, cost) for reel in reels]
    if apply:
        reels = [matcher.applied(reel) for reel in reels]
    records = tuple(reel.record for reel in reels)
    return Matching(
        *(target, eta == "auto", matcher.settings.tolerance, step, cost, records, where),
        signals=common.signals,
    )


def common_description(descriptions: Sequence[RigDescription]) -> RigDescription:
    """The first rig's description with the longest settling time of all."""
    return replace(
        descriptions[0], settling_time_s=max(rig.settling_time_s for rig in descriptions)
    )


def _worst(reels: Sequence[ReelProgress]) -> float:
    """The cost that all tuned reels can reach: the highest upper end of an interval."""
    costs = [r.record.tuned_cost for r in reels if not r.failed]
    highs = [cost.high for cost in costs if cost and math.isfinite(cost.high)]
    if len(highs) < 2:
        raise RigError(
            f"eta auto takes the worst of several tuned reels, and {len(highs)} could be tuned "
            f"({_reasons(reels)}); repair them, or give an eta"
        )
    return max(highs)


def _reasons(reels: Sequence[ReelProgress]) -> str:
    return "; ".join(f"{r.record.label}: {r.record.reason}" for r in reels if r.failed)


def _labelled(targets: Mapping[str, Any] | Sequence[Any]) -> dict[str, Any]:
    """The targets by label; without labels they are numbered."""
    if isinstance(targets, Mapping):
        labelled = {str(label): target for label, target in targets.items()}
    else:
        if isinstance(targets, str):
            raise InvalidInput(f"give a list of targets, not the text {targets!r}")
        labelled = {f"reel{n}": target for n, target in enumerate(targets, 1)}
    if not labelled:
        raise InvalidInput("there is no reel to match; give at least one target")
    endpoints = [target for target in labelled.values() if is_endpoint(target)]
    if len(set(endpoints)) < len(endpoints):
        raise InvalidInput(
            f"endpoints {', '.join(endpoints)}: one rig is given twice; leave one out"
        )
    for label in labelled:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", label):
            raise InvalidInput(f"label {label!r} may hold only letters, digits, - and _")
    return labelled


def free_folder() -> Path:
    """A folder of the present time."""
    return Path(FOLDER) / datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
