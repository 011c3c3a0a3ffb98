"""Conformance suite of a physical effect; see `plants.effects.effect`."""

import itertools
import math
import re
from collections.abc import Iterable

import casadi as ca
import numpy as np
import pytest

from estune.errors import InvalidInput
from estune.trial.profiles import StepProfile
from plants.conformance.reel_runs import DOWN, REEL, UP, readings, rest, rollout, trial, wander
from plants.effects import Effect, EyeletFriction, RecordScale, Role

RESTLESS = wander(160, -15.0, 60.0)
"""An effort beyond the current limits, and through slack."""
COUNT_rad = 2.0 * np.pi / REEL.encoder_counts
UNKNOWN = RecordScale()
"""The scale of records that show nothing."""
KNOWN = RecordScale(
    **{name: 1.0 for name, default in UNKNOWN._asdict().items() if default != ()},
    resonances_Hz=(50.0,),
    periods_per_turn=(24.0,),
)
"""The scale of records that show all."""
SHOWN = RecordScale(
    sample_s=1.0 / REEL.sampling_Hz,
    record_s=10.0,
    window_s=0.14,
    torque_rms_Nm=0.3,
    torque_max_Nm=3.0,
    angle_rms_rad=0.1,
    velocity_rms_rad_s=1.0,
    velocity_max_rad_s=10.0,
    current_rms_A=0.6,
    current_max_A=6.0,
    current_rate_A_s=1e3,
    reading_max_N=40.0,
    stretch_max_m=6e-3,
    turn_periods=8.0,
    preload_N=20.0,
    cable_length_m=REEL.cable_length_m,
)
"""That of records of the reel of this suite, within whose bounds a fit moves."""

CORNERS = 256
"""Most corners of the bounds that are tried. Up to eight parameters have all of theirs; of
more, as the fifteen of cogging with 32 768 corners, every three parameters meet in all their ways
(of eight ways one is missed by chance in 1e-15)."""


def corners(bounds: list[tuple[float, float]]) -> Iterable[tuple[float, ...]]:
    """All corners of some bounds; of too many, the two extreme ones and others by chance."""
    if 2 ** len(bounds) <= CORNERS:
        return itertools.product(*bounds)
    chosen = np.random.default_rng(0).integers(0, 2, (CORNERS, len(bounds)))
    chosen[0], chosen[1] = 0, 1
    return [tuple(b[n] for b, n in zip(bounds, row, strict=True)) for row in chosen.tolist()]


class EffectConformance:
    """Tests of an effect on a reel: the fixture `effect`, which a subclass must define."""

    @pytest.fixture
    def effect(self) -> type[Effect]:
        """The effect under test."""
        raise NotImplementedError("define the fixture `effect`: your class derived from Effect")

    def test_effect_declaration_is_complete(self, effect: type[Effect]) -> None:
        assert re.fullmatch(r"[a-z]+(_[a-z]+)*", effect.name)
        assert len(effect.title.split()) >= 2
        assert len(effect.appearance.split()) >= 8
        assert effect() != effect.neutral()

    def test_parameters_are_checked_against_their_bounds(self, effect: type[Effect]) -> None:
        declared = effect.parameters()
        assert any(p.neutral is not None for p in declared.values())
        for name, p in declared.items():
            assert p.low <= getattr(effect(), name) <= p.high
            assert p.neutral in (None, getattr(effect.neutral(), name))
            beyond = [edge for edge in (p.low - 1.0, p.high + 1.0) if math.isfinite(edge)]
            for wrong in (*beyond, math.nan, math.inf):
                with pytest.raises(InvalidInput, match=f"{effect.name}: {name} is"):
                    effect(**{name: wrong})

    def test_fit_begins_within_the_bounds(self, effect: type[Effect]) -> None:
        assert effect.named(Role.SIZE, Role.LIMIT)
        for records in (UNKNOWN, KNOWN):
            for name, p in effect.parameters().items():
                low, start, high = effect.range(name, records)
                assert p.low <= low <= start <= high <= p.high
                assert low < high < math.inf
                assert all(low <= value <= high for value in effect.guesses(name, records))
        usual = {name: getattr(effect(), name) for name in effect.parameters()}
        assert effect.matters(usual, UNKNOWN)

    def test_sentence_gives_the_fitted_size(self, effect: type[Effect]) -> None:
        usual = {name: getattr(effect(), name) for name in effect.parameters()}
        assert re.search(r"\d", effect.sentence(usual, REEL))

    @pytest.mark.parametrize("profile", [UP, DOWN], ids=["up", "down"])
    def test_neutral_effect_changes_nothing(
        self, effect: type[Effect], profile: StepProfile
    ) -> None:
        bare, neutral = trial(REEL, profile), trial(REEL + effect.neutral(), profile)
        for column in ("tension_N", "effort_N"):
            assert getattr(neutral, column) == pytest.approx(getattr(bare, column), abs=1e-8)
        assert np.abs(neutral.angle_rad - bare.angle_rad).max() < 1.5 * COUNT_rad

    def test_usual_effect_changes_the_response(self, effect: type[Effect]) -> None:
        bare, changed = (np.stack(rollout(r, RESTLESS)[:4]) for r in (REEL, REEL + effect()))
        change = np.abs(changed - bare).max(axis=1)
        assert (change / np.ptp(bare, axis=1)).max() > 1e-4

    @pytest.mark.parametrize("preload", [8.0, 30.0])
    def test_trial_with_the_effect_begins_settled(
        self, effect: type[Effect], preload: float
    ) -> None:
        reel = REEL + effect()
        _, effort = rest(reel, preload)
        held = rollout(reel, np.full(60, effort), preload)
        assert np.abs(held.omega).max() < 1e-7
        assert np.ptp(held.theta) < 1e-9
        assert held.tension[0] == pytest.approx(preload, abs=1e-6)

    def test_effect_derivatives_match_finite_differences(self, effect: type[Effect]) -> None:
        reel, names = REEL + effect(), list(effect.parameters())
        p, seen = readings(reel, RESTLESS)
        direction = ca.MX.sym("direction", p.numel())
        run = ca.Function("run", [p], [seen])
        slope = ca.Function("slope", [p, direction], [ca.jtimes(seen, p, direction)])
        first = p.numel() - len(names)
        for n, (name, declared) in enumerate(effect.parameters().items()):
            unit = np.zeros(p.numel())
            unit[first + n] = 1.0
            value = getattr(reel.effects[-1], name)
            for here in {value, declared.neutral} - {None}:
                at = reel.parameter_values + (here - value) * unit
                assert np.isfinite(np.asarray(slope(at, unit))).all()
            if not effect.smooth:
                continue
            found = np.asarray(slope(reel.parameter_values, unit)).ravel()
            low, _, high = effect.range(name, SHOWN)
            h = 1e-6 * min(high - value or 1.0, value - low or 1.0, max(abs(value), 0.01))
            ahead, behind = (
                np.asarray(run(reel.parameter_values + s * h * unit)).ravel() for s in (1, -1)
            )
            # A sample in which an event comes later or earlier by the step itself may differ.
            off = np.abs(found - (ahead - behind) / (2 * h)) > 1e-3 * np.abs(found).max()
            assert off.mean() < 0.02
            # What only shapes a law, as its creep while it sticks, need not show in every trial.
            assert np.abs(found).max() > 0.0 or isinstance(declared.start, float)

    def test_effect_stays_finite_at_its_bounds(self, effect: type[Effect]) -> None:
        declared = effect.parameters()
        ranges = [effect.range(name, SHOWN) for name in declared]
        for values in corners([(r.low, r.high) for r in ranges]):
            reel = REEL + effect(**dict(zip(declared, values, strict=True)))
            for profile in (UP, DOWN):
                seen = trial(reel, profile)
                assert seen.ended[0] == seen.tension_N.size, values
                columns = np.stack([seen.tension_N, seen.effort_N, seen.angle_rad])
                assert np.isfinite(columns).all(), values

    def test_cable_never_pushes(self, effect: type[Effect]) -> None:
        extreme = effect(**{n: effect.range(n, SHOWN).high for n in effect.parameters()})
        for one in (effect(), extreme):
            watched = REEL + one + EyeletFriction.neutral()
            assert rollout(watched, RESTLESS).outside.min() >= 0.0
