"""What a found effect means, in plain words and with its fitted numbers.

Each effect of the catalogue has its own sentence; an effect of the user's own is told by its
title, its numbers and its appearance. Torques are told as tension at the cable too where there is
a drum, so that they can be held against what the gauge reads.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from plants.diagnosis.report.quantities import PlantScale, also, digits, share, si
from plants.effects import Effect


def sentence(effect: type[Effect], values: Mapping[str, float], model: Any) -> str:
    """What an effect is and how large, in plain words.

    Args:
        effect: The effect's class.
        values: Its parameters by name, as `own_units` tells them.
        model: The model it was found on.

    Returns:
        One or two sentences with their full stops.
    """
    scene = PlantScale.of(model)
    tell = _SENTENCES.get(effect.name)
    if tell is None:
        numbers = ", ".join(
            f"{name} {si(values[name], found.unit)}" for name, found in effect.parameters().items()
        )
        return (
            f"Your {scene.subject} has {effect.title}: {numbers}. "
            f"In the data: {effect.appearance}."
        )
    return f"Your {scene.subject} {tell(values, scene)}."


def _eyelet_friction(v: Mapping[str, float], at: PlantScale) -> str:
    B, lost = v["attenuation"], (1.0 - v["attenuation"]) * at.tension_N
    less = "" if math.isnan(lost) else f" ({at.reading(lost)} less at {at.reading(at.tension_N)})"
    inside, slowly = share(v["inner_share"]), at.speed(v["creep_rad_s"])
    return (
        f"has eyelet friction: outside tension is {B:.3g} of inside when winding in{less}, the "
        "other way round when paying out. After a reversal the cable sticks: "
        f"{inside} of what gives is inside the eyelet. Below {slowly} it creeps"
    )


def _coulomb_friction(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has dry friction{at.at_drum}: {at.torque(v['torque_Nm'])} against the motion, whatever "
        "the speed. A smaller change of the command moves nothing"
    )


def _stribeck_friction(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has dry friction that is largest at rest: {at.torque(v['coulomb_Nm'])} in motion and "
        f"{at.torque(v['excess_Nm'])} more at rest, which fades over "
        f"{at.speed(v['stribeck_rad_s'])}. It gives {at.travel(v['presliding_rad'])} before it "
        "slips; moved slowly, it sticks and slips"
    )


def _dahl_hysteresis(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has dry friction that gives before it slips: {at.torque(v['torque_Nm'])}, built up over "
        f"{at.travel(v['presliding_rad'])} after each reversal, so that small motions meet less"
    )


def _viscous_damping(v: Mapping[str, float], at: PlantScale) -> str:
    b = v["damping_Nms"]
    if at.subject == "plant":
        return (
            f"has more viscous friction than the model: {digits(b)} in the input's unit for each "
            "unit of the output per second"
        )
    cable = f" ({digits(b / at.radius_m**2)} N per m/s of cable)" if at.has_cable else ""
    return (
        f"has more viscous friction than the model: {digits(b)} N m s/rad{cable}, in proportion "
        "to the speed"
    )


def _dead_time(v: Mapping[str, float], at: PlantScale) -> str:
    d, samples = v["delay_s"], v["delay_s"] * at.sampling_Hz
    counted = "" if math.isnan(samples) else f", {samples:.3g} samples,"
    return (
        f"has dead time that the model lacks: every command acts {si(d, 's')}{counted} later, "
        f"which takes {digits(3600.0 * d)} degrees of phase at 10 Hz"
    )


def _current_saturation(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has a drive that gives no more than {at.current(v['limit_A'])}, however much is "
        "commanded; beyond it the controller's integral winds up"
    )


def _rate_limit(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has a drive whose current changes no faster than {at.current(v['rate_A_per_s'], '/s')}: "
        "large steps become ramps, small ones pass"
    )


def _gain_error(v: Mapping[str, float], _: PlantScale) -> str:
    more = "more" if v["error"] > 0.0 else "less"
    return (
        f"has a drive that gives {share(abs(v['error']))} {more} torque than the model says, at "
        "rest as well as in motion"
    )


def _gauge_nonlinearity(v: Mapping[str, float], at: PlantScale) -> str:
    c = v["curvature_per_N"]
    if at.subject == "plant":
        return f"has a gauge whose curve is bent: of an output y it reads {digits(c)} y² too much"
    T = at.tension_N if math.isfinite(at.tension_N) else 10.0
    more = "much" if c > 0.0 else "little"
    return (
        f"has a gauge whose curve is bent: at {at.reading(T)} it reads "
        f"{at.reading(abs(c) * T * T)} too {more}, at twice that "
        f"{at.reading(4.0 * abs(c) * T * T)} (curvature {c:.3g} 1/N)"
    )


def _gauge_offset(v: Mapping[str, float], at: PlantScale) -> str:
    more = "much" if v["offset_N"] > 0.0 else "little"
    return f"has a gauge that reads {at.reading(abs(v['offset_N']))} too {more} at any tension"


def _gauge_drift(v: Mapping[str, float], at: PlantScale) -> str:
    rate = v["rate_N_per_s"]
    return (
        f"has a gauge whose zero wanders {'up' if rate > 0.0 else 'down'} from the start of a "
        f"record, whatever happens: {at.reading(abs(rate))} in a second"
    )


def _gauge_resonance(v: Mapping[str, float], _: PlantScale) -> str:
    return (
        f"has a gauge with a second resonance, at {digits(v['frequency_Hz'])} Hz with a damping "
        f"ratio of {v['damping']:.2g}: {share(v['share'])} of the reading goes through it and "
        "rings after each blow, while angle and current do not"
    )


def _cable_stiffening(v: Mapping[str, float], at: PlantScale) -> str:
    square, cubic = v["stiffening_per_N"], v["cubic_per_N2"]
    if at.subject == "plant":
        pulled = f"{digits(square)} u² more where it is pulled" if square else ""
        either = f"{digits(cubic)} u³ more either way" if cubic else ""
        more = " and ".join(filter(None, (pulled, either)))
        return f"has a spring that stiffens: it holds {more}, u being what the linear law holds"
    T = at.tension_N if math.isfinite(at.tension_N) else 10.0
    bent = square * T + cubic * T * T
    terms = f"coefficient {square:.3g} 1/N" + (f", cubic {cubic:.3g} 1/N²" if cubic else "")
    more = "more" if bent > 0.0 else "less"
    return (
        f"has a cable that stiffens as it is pulled: where the linear law has {si(T, 'N')} it "
        f"pulls {share(abs(bent))} {more} ({terms})"
    )


def _cable_creep(v: Mapping[str, float], _: PlantScale) -> str:
    return (
        f"has a cable that creeps: after each change it gives another {share(v['share'])} of "
        f"what it gave at once, with a time constant of {si(v['time_s'], 's')}"
    )


def _cable_slack(v: Mapping[str, float], at: PlantScale) -> str:
    until = 2.0 * at.stiffness_N_m * v["slack_m"]
    firm = "" if math.isnan(until) else f"; from {si(until, 'N')} on it is as stiff as ever"
    return f"has {at.cable(v['slack_m'])} of slack that is taken up before the cable holds{firm}"


def _cable_weight(v: Mapping[str, float], at: PlantScale) -> str:
    sag = 9.81 * v["density_kg_m"] * at.length_m**2 / (8.0 * at.tension_N)
    seen = "" if math.isnan(sag) else (
        f": on {si(at.length_m, 'm')} at {si(at.tension_N, 'N')} it sags {si(sag, 'm')} more"
    )  # fmt: skip
    return (
        f"has a cable {1e3 * v['density_kg_m']:.3g} g/m heavier than the model's{seen}, and is "
        "softer at low tension"
    )


def _string_mode(v: Mapping[str, float], at: PlantScale) -> str:
    frequency = math.sqrt(at.tension_N / v["density_kg_m"]) / (2.0 * at.length_m)  # (31)
    where = "" if math.isnan(frequency) else f" at {frequency:.3g} Hz ({si(at.tension_N, 'N')})"
    return (
        f"has a cable of {1e3 * v['density_kg_m']:.3g} g/m that swings like a string{where}: "
        f"faster than that, {share(v['coupling'])} of its sag's give is lost"
    )


def _structural_mode(v: Mapping[str, float], at: PlantScale) -> str:
    T = at.tension_N if math.isfinite(at.tension_N) else 10.0
    stiffer = "" if at.subject == "plant" else (
        f" and is {share(v['stiffening_per_N'] * T)} stiffer at {at.reading(T)}"
    )  # fmt: skip
    return (
        f"stands on a frame that rings at {digits(v['frequency_Hz'])} Hz with a damping ratio of "
        f"{v['damping']:.2g} and gives {share(v['share'])} as much as the rest does{stiffer}"
    )


def _torque_ripple(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has a motor that cogs: its torque varies by {at.torque(v['amplitude_Nm'])} either way, "
        f"{digits(v['per_turn'])} times a turn, the same at each passage"
    )


def _drum_eccentricity(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has a drum that is not round: its radius varies by {share(v['eccentricity'])}"
        f"{also(v['eccentricity'] * at.radius_m, 'm')} either way, once a turn"
    )


def _backlash(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has backlash of {at.travel(v['play_rad'])} between motor and drum; the motor is "
        f"{100.0 * v['motor_share']:.0f} % of what turns and moves alone where the teeth part"
    )


def _quantisation(v: Mapping[str, float], at: PlantScale) -> str:
    return f"has a gauge that reads in steps of {at.reading(v['step_N'])}"


def _mains_interference(v: Mapping[str, float], at: PlantScale) -> str:
    return (
        f"has hum in the gauge's signal: {at.reading(v['amplitude_N'])} at "
        f"{v['frequency_Hz']:.4g} Hz, at rest as well as in motion"
    )


_SENTENCES: dict[str, Callable[[Mapping[str, float], PlantScale], str]] = {
    tell.__name__[1:]: tell
    for tell in (
        _backlash,
        _cable_creep,
        _cable_slack,
        _cable_stiffening,
        _cable_weight,
        _coulomb_friction,
        _current_saturation,
        _dahl_hysteresis,
        _dead_time,
        _drum_eccentricity,
        _eyelet_friction,
        _gain_error,
        _gauge_drift,
        _gauge_nonlinearity,
        _gauge_offset,
        _gauge_resonance,
        _mains_interference,
        _quantisation,
        _rate_limit,
        _stribeck_friction,
        _string_mode,
        _structural_mode,
        _torque_ripple,
        _viscous_damping,
    )
}
"""Ends of a sentence that begins "Your reel", by slug."""
