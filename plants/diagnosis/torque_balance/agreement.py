"""Two judges of one machine: the prediction of its motion, and the balance of its torques.

The prediction sees what has states, delays or play; where nothing holds a drive it integrates every
disturbance, so that a curve without a name or another inertia explains as much as a friction does.
The balance sees what acts as a torque at one moment, and nothing else. Where both name a law, that
is strong. What one of them alone can see is told with the reason. Where each names what the other
could see and does not, nothing is believed, and both are shown.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from plants.diagnosis.result import Slugs, Verdict
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
    """

    weight: Weight
    effects: tuple[type[Effect], ...] = ()


def agreement(
    verdict: Verdict,
    believed: Sequence[type[Effect]],
    tied: Sequence[str],
    leading: Slugs,
    judged: TorqueJudgement | None,
) -> Agreement:
    """How the judgement of a balance stands to the verdict of a prediction.

    Args:
        verdict: Of the prediction.
        believed: Effects that it names.
        tied: Slugs that it leaves open.
        leading: Slugs of the model that it would name first, believed or not.
        judged: What the balance says; None where it says nothing.
    """
    if judged is None or not judged.laws:
        return Agreement("silent")
    certain = judged.laws
    # Of laws that explain as much the one that predicts the motion best is believed.
    if judged.rivals and not {e.name for e in judged.effects[-1:]} & (leading | set(tied)):
        certain = certain[:-1]
    named = tuple(law.effect for law in certain if law.effect is not None)
    families = {family_of(e) for e in named}
    seen = {family_of(e) for e in believed if family_of(e) in VISIBLE}
    if verdict == "ambiguous":
        agreed = [e for e in named if e.name in tied]
        return Agreement("tie", (agreed[0],)) if len(agreed) == 1 else Agreement("silent")
    if verdict in ("unknown", "none"):
        return Agreement("balance", named) if named else Agreement("silent")
    if families <= seen:
        return Agreement("both") if families else Agreement("silent")
    # What predicts the motion to the noise is complete: the balance knows no other port.
    if verdict == "named":
        return Agreement("contradiction" if seen and not families & seen else "silent", named)
    if seen <= families and seen:
        return Agreement("balance", named)
    return Agreement("contradiction" if seen else "silent", named)


def family_of(effect: type[Effect]) -> str:
    """Name of an effect's family, or its own."""
    return effect.family or effect.name


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


def sentence(judged: TorqueJudgement, weight: Weight, scale: PlantScale) -> str:
    """What the balance says, in words."""
    before, after = (scale.torque(rms) for rms in (judged.before_Nm, judged.after_Nm))
    titles = " and ".join(law.title for law in judged.laws)
    effort = "forces" if scale.unit("N m") == "N" else "torques"
    left = (
        f"of {scale.torque(judged.torque_Nm)} rms inertia, viscous friction and what the model "
        f"declares leave {before}, {titles} {after}, on {judged.stretches} stretches of time "
        "left out in turn"
    )
    match weight:
        case "both":
            return f"The balance of {effort} says the same: {left}."
        case "tie":
            return f"The balance of {effort} decides: {left}."
        case "balance":
            return (
                f"The balance of {effort} names it, the prediction of the motion alone does not, "
                f"for it adds up every disturbance: {left}."
            )
        case "contradiction":
            return f"The balance of {effort} says otherwise: {left}."
    return ""
