"""Two judges of one machine: the prediction of its motion, and the balance of its torques.

The prediction sees what has states, delays or play; where nothing holds a drive it adds up every
disturbance, so that a curve without a name or another inertia explains as much as a friction does.
The balance sees what acts as a torque at one moment, and nothing else. Where both name a law, that
is strong. What one of them alone can see is told with the reason. Where each names what the other
could see and does not, nothing is believed, and both are shown.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from plants.diagnosis.result import Slugs, Verdict, family_of
from plants.diagnosis.torque_balance.judge import TorqueJudgement
from plants.effects import Effect
from plants.effects.plant_scale import PlantScale

Weight = Literal["silent", "both", "balance", "tie", "contradiction"]
"""`silent`: the balance names nothing; `both`: they agree; `balance`: it names what the prediction
does not; `tie`: the prediction leaves open what the balance names; `contradiction`."""


class Agreement(NamedTuple):
    """What two judges say together.

    Attributes:
        weight: How they stand to each other.
        effects: What is believed by the balance, beside or instead of what the prediction says.
        shared: Titles of those of them that the prediction names, too.
    """

    weight: Weight
    effects: tuple[type[Effect], ...] = ()
    shared: tuple[str, ...] = ()


SILENT, CONTRADICTION = Agreement("silent"), Agreement("contradiction")


def agreement(
    verdict: Verdict,
    believed: Sequence[type[Effect]],
    tied: Sequence[str],
    foreseen: Slugs,
    judged: TorqueJudgement | None,
) -> Agreement:
    """How the judgement of a balance stands to the verdict of a prediction.

    Args:
        verdict: Of the prediction.
        believed: Effects that it names.
        tied: Slugs that it leaves open, and fuller laws of one it names that explain no less.
        foreseen: Slugs of what it would name first, believed or not.
        judged: What the balance says; None where it says nothing.
    """
    named = _certain(judged, foreseen | set(tied)) if judged is not None else ()
    families = {family_of(e) for e in named}
    seen = {family_of(e) for e in believed if family_of(e) in VISIBLE}
    agreed = [e for e in named if e.name in tied]
    if len(agreed) == 1 and (verdict == "ambiguous" or families == seen):
        return Agreement("tie", (agreed[0],))
    if verdict == "ambiguous":
        return SILENT
    # What predicts the motion to the noise is complete: the balance knows no other port.
    complete = verdict == "named" and bool(families & seen or not seen)
    alone = verdict in ("unknown", "none")
    if not named or ((complete or not seen) and not alone and not families <= seen):
        return SILENT
    if not alone and families <= seen:
        return Agreement("both")
    shared = tuple(e.title for e in named if family_of(e) in seen)
    return Agreement("balance", named, shared) if seen <= families else CONTRADICTION


def _certain(judged: TorqueJudgement, foreseen: frozenset[str]) -> tuple[type[Effect], ...]:
    """The laws that the balance is sure of.

    Of laws that explain as much the one that predicts the motion best is believed.
    """
    named = judged.effects
    if judged.rivals and not {e.name for e in named[-1:]} & foreseen:
        return named[:-1]
    return named


VISIBLE = frozenset(
    (
        "dry friction",
        "load_friction",
        "link_gravity",
        "bent_viscous_friction",
        "directional_friction",
    )
)
"""Families that act as a torque at one moment."""


def sentence(judged: TorqueJudgement, together: Agreement, scale: PlantScale) -> str:
    """What the balance says, in words."""
    before, after = (scale.torque(rms) for rms in (judged.before_Nm, judged.after_Nm))
    titles = " and ".join(law.title for law in judged.laws)
    effort = "forces" if scale.unit("N m") == "N" else "torques"
    left = (
        f"of {scale.torque(judged.torque_Nm)} rms inertia, viscous friction and what the model "
        f"declares leave {before}, {titles} {after}, on {judged.stretches} stretches of time "
        "left out in turn"
    )
    if judged.held_Nm is not None:
        before, after = (scale.torque(rms) for rms in judged.held_Nm)
        left += f"; on the held-out records {after} of {before}"
    match together.weight:
        case "both":
            return f"The balance of {effort} says the same: {left}."
        case "tie":
            return f"The balance of {effort} decides: {left}."
        case "balance":
            alone = "names it"
            if together.shared:
                alone = (
                    f"and the prediction name {' and '.join(together.shared)}, it alone the rest"
                )
            return (
                f"The balance of {effort} {alone}: {left}. The prediction of the motion adds up "
                "every disturbance"
            )
        case "contradiction":
            return f"The balance of {effort} says otherwise: {left}."
    return ""
