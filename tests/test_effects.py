import re
from dataclasses import dataclass, replace
from importlib import metadata

import casadi as ca
import numpy as np
import pytest

import plants
from estune.errors import InvalidInput
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile
from experiments.paper.identify import Band, multisine, open_loop_record
from plants import effects
from plants.conformance.effect import EffectConformance
from plants.conformance.reel_runs import GAINS, REEL, UP, readings, rest, rollout, wander
from plants.effects import EFFECTS, Effect, EyeletFriction, Port, Quantisation, RecordScale, Role
from plants.simulation.trial_loop import CasadiLoop, CompiledLoop, loop_functions

SLUGS = [
    *("coulomb_friction", "stribeck_friction", "dahl_hysteresis", "eyelet_friction"),
    *("viscous_damping", "dead_time", "current_saturation", "rate_limit", "gain_error"),
    *("gauge_nonlinearity", "gauge_offset", "gauge_drift", "gauge_resonance"),
    *("cable_stiffening", "cable_creep", "cable_slack", "cable_weight", "string_mode"),
    *("structural_mode", "torque_ripple", "drum_eccentricity", "backlash", "quantisation"),
    "mains_interference",
]


def example():
    """The effect that the documentation writes, run as it stands there."""
    text = re.search(r"```python\n(.*?)```", effects.__doc__, re.DOTALL).group(1)
    names = {}
    exec(text, names)  # noqa: S102  the documentation's own code
    return names["RewindSpring"]


Own = example()
CASES = {**EFFECTS, "one's own": Own}


class TestEveryEffect(EffectConformance):
    @pytest.fixture(params=CASES.values(), ids=CASES)
    def effect(self, request):
        return request.param


def all_on(order):
    """A reel with every effect, added forward or backward."""
    reel = REEL
    for effect in [*CASES.values()][::order]:
        reel = reel + effect()
    return reel


def test_every_canonical_effect_has_a_file_of_its_name():
    assert set(SLUGS) <= set(EFFECTS)
    for name, effect in EFFECTS.items():
        assert effect.__module__ == f"plants.effects.{name}"
        assert effects.find(name) is effect


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
def test_effect_docstring_has_law_and_units(effect):
    assert "=" in effect.__doc__ or "<=" in effect.__doc__
    for name, p in effect.parameters().items():
        (line,) = re.findall(rf"^ +{name}: (.*(?:\n {{12}}.*)*)", effect.__doc__, re.MULTILINE)
        assert not p.unit or f" {p.unit}" in line


@pytest.mark.parametrize("order", [1, -1], ids=["forward", "backward"])
def test_trial_with_all_effects_begins_settled(order):
    reel = all_on(order)
    _, effort = rest(reel, 20.0)
    held = rollout(reel, np.full(60, effort), 20.0)
    assert np.abs(held.omega).max() < 1e-6
    assert held.tension[0] == pytest.approx(20.0, abs=0.5 * Quantisation().step_N + 1e-9)


def test_dead_time_has_a_derivative_at_zero():
    reel = REEL + EFFECTS["dead_time"].neutral()
    p, seen = readings(reel, wander(60, 12.0, 20.0))
    run = ca.Function("run", [p], [seen])
    unit = np.eye(p.numel())[-1]
    found = np.asarray(
        ca.Function("slope", [p], [ca.jtimes(seen, p, unit)])(reel.parameter_values)
    )
    ahead = np.asarray(run(reel.parameter_values + 1e-8 * unit) - run(reel.parameter_values))
    assert found == pytest.approx(ahead / 1e-8, abs=1e-4 * np.abs(found).max())
    assert np.abs(found).max() > 0.0


FRICTIONLESS = plants.reference_reel(
    tension_N=20.0,
    viscous_friction_Nms=0.0,
    viscous_friction_per_length_Ns=0.0,
    dead_time_s=0.0,
)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 1.0], ids="{:g}".format)
@pytest.mark.parametrize(
    "name", ["coulomb_friction", "stribeck_friction", "dahl_hysteresis", "viscous_damping"]
)
def test_friction_adds_no_energy(name, share):
    usual, declared = EFFECTS[name](), EFFECTS[name].parameters()
    strength = next(iter(declared))
    value = getattr(usual, strength) + share * (1e4 - getattr(usual, strength))
    effect = replace(usual, **{strength: value})
    if hasattr(effect, "presliding_rad") and share == 1.0:  # stiff bristles are the hard case
        effect = replace(effect, presliding_rad=1e-7)
    J = FRICTIONLESS.drum_inertia_kg_m2
    seen = rollout(FRICTIONLESS + effect, np.where(np.arange(600) < 3, 40.0, 20.0), 20.0)
    swing = seen.theta - seen.theta[0]
    energy = 0.5 * J * (seen.omega**2 + (FRICTIONLESS.natural_frequency_rad_s * swing) ** 2)
    # Bristles give back what they took up, never more.
    size = value + getattr(effect, "excess_Nm", 0.0)
    stored = 0.5 * size * getattr(effect, "presliding_rad", 0.0)
    least = np.minimum.accumulate(energy[4:])
    assert (energy[4:] - least).max() <= stored + 1e-9 * energy.max()
    left = 0.5 if share == 0.0 else 1.0  # in treacle the drum takes minutes to creep back
    assert energy[-1] <= left * energy[4] + stored + 1e-30


@pytest.mark.parametrize(
    "order", [1, pytest.param(-1, marks=pytest.mark.slow)], ids=["forward", "backward"]
)
def test_compiled_trial_equals_that_of_the_virtual_machine(order, monkeypatch):
    reel = all_on(order)
    seen = []
    virtual = CasadiLoop(loop_functions(reel.structure.equations()))
    for loop in (CompiledLoop(reel.structure), virtual):
        monkeypatch.setattr("plants.models.plant_model.trial_loop", lambda _, loop=loop: loop)
        noise = np.random.default_rng(3).normal(0.0, 0.05, UP.samples(REEL.sampling_Hz))
        seen.append(plants.simulate(reel, GAINS, UP, noise_N=noise))
    for column in ("tension_N", "effort_N", "angle_rad", "reference_N"):
        compiled, virtual = (getattr(one, column) for one in seen)
        assert compiled == pytest.approx(virtual, rel=1e-9, abs=1e-9)


def test_outside_tension_is_recorded_with_eyelet_friction():
    request = TrialRequest("run", 0, GAINS, StepProfile(15.0, 10.0, 0.05, 0.3))
    record = (REEL + EyeletFriction()).rig().run(request)
    assert record.reference_N.shape == record.tension_N.shape
    assert np.abs(record.reference_N / record.tension_N - 1.0).max() > 0.03
    assert REEL.rig().run(request).reference_N is None
    band = Band(low_Hz=2.0, high_Hz=50.0, period_s=0.5, periods=2)
    record = open_loop_record(
        REEL + EyeletFriction(), multisine(REEL.sampling_Hz, band, 8.0), None
    )
    assert np.abs(record.reference_N / record.tension_N - 1.0).max() > 0.03


def test_user_effect_is_found_by_reference_and_entry_point(monkeypatch):
    point = metadata.EntryPoint("drag", "plants.effects:ViscousDamping", effects.GROUP)
    monkeypatch.setattr(effects, "entry_points", lambda group: [point] * (group == effects.GROUP))
    assert effects.find("drag") is EFFECTS["viscous_damping"]
    assert effects.find("tests.test_effects:Own") is Own


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("colomb_friction", "there are backlash"),
        ("plants.nowhere:Effect", "cannot be loaded"),
        ("plants.effects:Nothing", "cannot be loaded"),
        ("plants.effects:find", "class derived from Effect"),
        (":", "cannot be loaded"),
    ],
)
def test_missing_effect_is_reported(name, told):
    with pytest.raises(InvalidInput, match=told) as caught:
        effects.find(name)
    assert "\n" not in str(caught.value)


def test_field_that_is_no_parameter_is_reported():
    class Careless(Effect):
        name = "careless"
        port = Port.DRUM
        __annotations__ = {"size": float}
        size = 1.0

    with pytest.raises(InvalidInput, match="size has to be declared"):
        dataclass(frozen=True)(Careless)()


def test_roles_follow_from_the_declaration_unless_given():
    declared = EFFECTS["torque_ripple"].parameters()
    assert [p.role for p in declared.values()] == [Role.SIZE, Role.PERIODS, Role.PHASE]
    assert EFFECTS["gauge_resonance"].named(Role.FREQUENCY) == ("frequency_Hz",)
    assert EFFECTS["rate_limit"].named(Role.LIMIT) == ("rate_A_per_s",)
    assert Own.named(Role.SHAPE) == ("turns",)


def test_fit_of_friction_begins_at_a_share_of_the_torque_in_the_records():
    records = RecordScale(torque_rms_Nm=0.5, torque_max_Nm=1.0)
    assert EFFECTS["coulomb_friction"].range("torque_Nm", records) == (0.0, 0.05, 2.0)
    assert EFFECTS["coulomb_friction"].range("torque_Nm", RecordScale()) == (0.0, 0.02, 20.0)
    moving = RecordScale(velocity_rms_rad_s=1.0, velocity_max_rad_s=3.0)
    assert EFFECTS["coulomb_friction"].range("creep_rad_s", moving) == (0.0, 0.0, 6.0)


def test_guesses_of_a_string_are_the_densities_that_ring_where_the_residual_does():
    records = RecordScale(preload_N=20.0, cable_length_m=1.0, resonances_Hz=(0.0, 10.0))
    assert EFFECTS["string_mode"].guesses("density_kg_m", records) == (pytest.approx(0.05),)
    assert EFFECTS["string_mode"].guesses("density_kg_m", RecordScale()) == ()


def test_effect_does_not_matter_below_its_least_size():
    dead_time = EFFECTS["dead_time"]
    assert not dead_time.matters({"delay_s": 1e-4}, RecordScale(sample_s=1e-3))
    assert dead_time.matters({"delay_s": 3e-4}, RecordScale(sample_s=1e-3))
    friction = {"coulomb_Nm": 0.02, "excess_Nm": 0.001}
    friction |= {"stribeck_rad_s": 0.5, "presliding_rad": 1e-5, "spread": 1.0}
    assert not EFFECTS["stribeck_friction"].matters(friction, RecordScale(), distinct=True)
    slack = EFFECTS["cable_slack"]
    assert not slack.matters({"slack_m": 2e-3}, RecordScale(stretch_max_m=1e-3))


@pytest.mark.parametrize(("per_turn", "is_ripple"), [(0.99, False), (1.3, False), (7.0, True)])
def test_wave_that_records_do_not_tell_from_gravity_is_no_ripple(per_turn, is_ripple):
    wave = {"amplitude_Nm": 0.01, "per_turn": per_turn, "phase_rad": 0.1}
    assert EFFECTS["torque_ripple"].matters(wave, RecordScale(turn_periods=1.0)) == is_ripple


def test_extended_effects_are_in_the_catalogue_and_pass_on_their_parameters():
    for effect in EFFECTS.values():
        simpler = effect.extends
        assert (simpler is None) == (not effect.inherits)
        if simpler is not None:
            assert EFFECTS[simpler.name] is simpler
            assert set(effect.inherits) <= set(effect.parameters())
            assert set(effect.inherits.values()) <= set(simpler.parameters())
