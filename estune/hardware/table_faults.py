"""Whether the tables of a rig's file fit each other: each fault as a sentence."""

from collections.abc import Iterator

from estune.hardware.rig_tables import RigTables
from estune.support.quantity_text import with_unit
from estune.trial.signals import Signals


def table_faults(rig: RigTables) -> Iterator[str]:
    """What does not fit; nothing where all does."""
    yield from _reel_keys(rig)
    yield from _tensions(rig)
    yield from _currents(rig)
    yield from _times(rig)


def _reel_keys(rig: RigTables) -> Iterator[str]:
    """What a reel must have, and another machine may leave out."""
    motion, reel = rig.motion, rig.reel
    if (motion.taut_N is None) != (motion.take_up_A is None):
        yield "give both motion.taut_N and motion.take_up_A, or neither"
    if not rig.is_reel:
        return
    needed = {
        "reel.drum_radius_m": "drum_radius_m" in reel.model_fields_set,
        "reel.torque_constant_Nm_A": "torque_constant_Nm_A" in reel.model_fields_set,
        "reel.encoder_counts_per_turn": "encoder_counts_per_turn" in reel.model_fields_set,
        "guard.slack_N": rig.guard.slack_N is not None,
        "motion.take_up_A": motion.take_up_A is not None,
        "motion.taut_N": motion.taut_N is not None,
    }
    if missing := ", ".join(name for name, given in needed.items() if not given):
        yield f'give {missing}; or, if it is no reel, what it measures: measurement = "angle, rad"'


def _tensions(rig: RigTables) -> Iterator[str]:
    low, high, step = rig.limits.tension_min_N, rig.limits.tension_max_N, rig.step.profile
    unit = Signals(rig.measurement).measurement_unit
    values = {
        "step.preload_N": step.preload_N,
        "step.preload_N + step.step_N": step.preload_N + step.step_N,
        "motion.hold_N": rig.hold_N,
    }
    if rig.hybrid is not None:
        least, margin = rig.hybrid.tension_min_N, rig.hybrid.margin_N
        values["hybrid.tension_min_N"] = least
        values["hybrid.tension_min_N + 2 margin_N"] = least + 2.0 * margin
    for name, tension in values.items():
        if not low <= tension <= high:
            yield (
                f"{name} {with_unit(tension, unit, 6)} is outside limits.tension_N {low:g} to "
                f"{with_unit(high, unit, 6)}"
            )
    guard, taut_N = rig.guard, rig.motion.taut_N
    if not guard.tension_max_N > high:
        yield (
            f"guard.tension_max_N {with_unit(guard.tension_max_N, unit, 6)} must be above "
            f"limits.tension_max_N {with_unit(high, unit, 6)}, or a good trial trips it"
        )
    if guard.slack_N is not None and not guard.slack_N < low:
        yield f"guard.slack_N {guard.slack_N:g} must be below limits.tension_min_N {low:g}"
    if guard.slack_N is not None and taut_N is not None and not guard.slack_N < taut_N:
        yield f"guard.slack_N {guard.slack_N:g} must be below motion.taut_N {taut_N:g}"


def _currents(rig: RigTables) -> Iterator[str]:
    low, high = rig.limits.current_min_A, rig.limits.current_max_A
    take_up_A, taut_N = rig.motion.take_up_A, rig.motion.taut_N
    values = {"safe.current_A": rig.safe.current_A}
    if take_up_A is not None:
        values["motion.take_up_A"] = take_up_A
    for name, current in values.items():
        if not low <= current <= high:
            yield f"{name} {current:g} A is outside limits.current_A {low:g} to {high:g} A"
    if not rig.is_reel:  # what its command holds at rest is not known
        return
    pull_N = (take_up_A or 0.0) * rig.newtons_per_ampere
    if taut_N is not None and take_up_A is not None and not taut_N < pull_N:
        yield (
            f"motion.taut_N {taut_N:g} N must be below what motion.take_up_A "
            f"{take_up_A:g} A pulls at rest, {pull_N:g} N"
        )
    held_N = high * rig.newtons_per_ampere
    if not rig.limits.tension_max_N <= held_N:
        yield (
            f"limits.current_max_A {high:g} A holds {held_N:g} N, less than limits.tension_max_N "
            f"{rig.limits.tension_max_N:g} N"
        )


def _times(rig: RigTables) -> Iterator[str]:
    step, limits = rig.step.profile, rig.limits
    if not step.duration_s <= limits.duration_max_s:
        yield (
            f"step.duration_s {step.duration_s:g} s is longer than limits.duration_max_s "
            f"{limits.duration_max_s:g} s"
        )
    recorded_s = step.duration_s - step.step_at_s
    if not rig.settling_time_s <= recorded_s:
        yield (
            f"settling_time_s {rig.settling_time_s:g} s is longer than what the step records "
            f"after it, {recorded_s:g} s"
        )
    if not rig.guard.gap_s > 1.0 / rig.sampling_Hz:
        yield (
            f"guard.gap_s {rig.guard.gap_s:g} s is shorter than a sampling period, "
            f"{1.0 / rig.sampling_Hz:.4g} s"
        )
