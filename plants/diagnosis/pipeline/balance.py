"""The judgement of the torque balance on the records of a fit, and a model with its values."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.models.free_parameters import BASE
from plants.diagnosis.pipeline.fit import BaseFit
from plants.diagnosis.result import family_of
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.torque_balance.agreement import VISIBLE
from plants.diagnosis.torque_balance.balance import INERTIA, OFFSET, VISCOUS, torque_balance
from plants.diagnosis.torque_balance.judge import TorqueJudgement, judge
from plants.diagnosis.torque_balance.laws import CHANGING
from plants.effects import EFFECTS, Effect, Port, RateLimit, Role
from plants.effects.plant_scale import PlantScale

ZERO = "encoder_zero_rad["


def judgement(fitted: BaseFit, held_out: Sequence[MeasuredRecord] = ()) -> TorqueJudgement | None:
    """What the balance of torques says; None where it cannot be judged.

    It is of a drive that nothing holds, whose declared effects are all laws of a torque. All laws
    are looked at, whatever the search may choose from: another one in the place of the one that is
    there would be a wrong name.
    """
    plant = fitted.plant
    free = _free(fitted)
    declared = [type(effect) for effect in plant.effects]
    encoder = fitted.noise.channels.get("angle_rad")
    unseen = any(family_of(e) not in VISIBLE for e in declared)
    if len(free) < len(plant.measurements) or unseen or encoder is None:
        return None
    turns = PlantScale.of(plant.model).unit("rad") == "rad"
    of_torque = [e for e in EFFECTS.values() if family_of(e) in VISIBLE]
    looked = [e for e in of_torque if turns or e.name != "link_gravity"]
    judged = None
    for _ in range(2):
        balance = torque_balance(plant.measurements, free, encoder)
        narrower = torque_balance(plant.measurements, free, encoder, CONSTANTS.kernel_narrower)
        if balance is None:
            return None
        others = [b for m in held_out if (b := BaseNumbers.of(plant.model, m)) is not None]
        aside = torque_balance(held_out, others, encoder, like=balance) if held_out else None
        judged = judge(balance, looked, declared, narrower, aside)
        if free == (free := _free(fitted, judged)):
            break
    offered = judged and all(e in fitted.choices.structural for e in judged.effects)
    return judged if offered else None


def _free(fitted: BaseFit, judged: TorqueJudgement | None = None) -> list[BaseNumbers]:
    """The numbers of the records on which nothing holds the drive, by a judgement if there is one.

    The kernel follows from the inertia. Of one that was given ten times too large it is so wide
    that the velocity changes its sign too late, which looks like a friction that fades.
    """
    plant = fitted.plant
    numbers = [BaseNumbers.of(plant.model, m) for m in plant.measurements]
    free = [b for b in numbers if b is not None and b.is_free]
    shown = judged.base[INERTIA].value if judged else 0.0
    off = [shown / b.drum_inertia_kg_m2 for b in free]
    if shown > 0.0 and any(not 1.0 / CONSTANTS.model_off < x < CONSTANTS.model_off for x in off):
        return [replace(b, drum_inertia_kg_m2=shown) for b in free]
    return free


def disputed(
    fitted: BaseFit, judged: TorqueJudgement, fit: CandidateFit
) -> frozenset[type[Effect]]:
    """Effects of a fit that the balance of torques does not bear out.

    A law that it could see of this size, and that takes nothing off what its own laws leave: an
    inertia far from the given one looks to a prediction like a share of the load. And limits: a
    command that was logged as its mean, or at other moments than the angle, looks to a
    prediction as if a limit had cut it: torques then balance worse with the limit. One that acts
    in a single stretch of time may be any disturbance; it is not believed beside another effect,
    nor where the torques balance without it. A dry friction of constant size is not believed where
    it halves in the course of a record.
    """
    limits = [e for e in fit.effects if e.port is Port.ACTUATOR and e.named(Role.LIMIT)]
    plant, free, encoder = fitted.plant, _free(fitted, judged), fitted.noise.channels["angle_rad"]
    more = [e for e in fit.effects if family_of(e) in VISIBLE - judged.families]
    whole = torque_balance(plant.measurements, free, encoder) if limits or more else None
    found = {e for e in fit.effects if judged.changes_Nm and family_of(e) == CHANGING.family}
    if whole is None:
        return frozenset(found)
    found |= {e for e in more if judged.laws and judged.denies(whole, e, fit.values)}
    beside = len(fit.effects) > 1
    for effect in limits:
        (name,) = effect.named(Role.LIMIT)
        most = fit.values[f"{effect.name}.{name}"] * plant.drive_unit
        per_sample = effect is RateLimit
        limited = [
            _limited(m, b, most / m.sampling_Hz if per_sample else most, slewing=per_sample)
            for m, b in zip(plant.measurements, free, strict=True)
        ]
        balance = torque_balance(limited, free, encoder)
        pairs = zip(plant.measurements, limited, strict=True)
        acts = sum(_stretches(m, cut, plant.newtons_per_ampere) for m, cut in pairs)
        if acts <= 1 and (beside or judged.is_complete):
            found.add(effect)
        if balance is not None and judged.disputes(balance, whole, beside=beside):
            found.add(effect)
    return frozenset(found)


def _stretches(m: MeasuredRecord, cut: MeasuredRecord, newtons_per_ampere: float) -> int:
    """Twentieths of a record in which a limit changes its command."""
    changed = np.not_equal(cut.command_A(newtons_per_ampere), m.command_A(newtons_per_ampere))
    return sum(bool(part.any()) for part in np.array_split(changed, 20))


def _limited(m: MeasuredRecord, b: BaseNumbers, most: float, *, slewing: bool) -> MeasuredRecord:
    command = m.command_A(b.newtons_per_ampere)
    if not slewing:
        return replace(m, loop="closed", current_A=np.clip(command, -most, most))
    followed, at = np.empty(command.size), float(command[0])
    for n, wanted in enumerate(command.tolist()):
        at += min(max(wanted - at, -most), most)
        followed[n] = at
    return replace(m, loop="closed", current_A=followed)


def with_values(
    fitter: ModelFitter, effects: Sequence[type[Effect]], judged: TorqueJudgement, *, sized: bool
) -> CandidateFit:
    """The model with effects as the balance has them.

    Args:
        judged: What the balance says.
        sized: Whether a prediction that names a part of them sizes them all; otherwise only values
            of single records are fitted.
    """
    predictor = fitter.predictor(tuple(effects))
    base = {
        "drum_inertia_kg_m2": judged.base[INERTIA].value,
        "viscous_friction_Nms": judged.base[VISCOUS].value,
        "torque_offset_Nm": -judged.base[OFFSET].value,
    }
    zeros = [f.name for f in predictor.free if f.name.startswith(ZERO)]
    # What the balance does not see, as how far friction gives before it slips, is as little as can
    # be: the balance's laws are rigid.
    rigid = {f.name: f.low for f in predictor.free if f.owner not in (BASE, "")}
    values = rigid | {name: at.value for name, at in judged.values.items()} | base
    row = predictor.row(values | dict.fromkeys(zeros, 0.0))
    # A friction that is not told from zero may come out below.
    least = [f.low if f.owner == BASE else -np.inf for f in predictor.free]
    row = np.maximum(row, least)
    if sized:
        return fitter.final(fitter.fit(tuple(effects), row))
    return fitter.fit(tuple(effects), row, owners=frozenset(), held=zeros)
