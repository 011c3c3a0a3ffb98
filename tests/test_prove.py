"""A remedy as a patch of a rig's file, and its proof by trials with it and without."""

import json
import math
import re
import tomllib
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import ttest_ind

import estune
import plants
from estune.cli import run
from estune.errors import InvalidInput, RigError
from estune.hardware.config import read_config
from estune.proof import trials
from estune.proof.patch import Patch, patch_of, read_patch, read_proven
from estune.proof.trials import MeasuredRatio, Proof, RemedyRig, prove
from estune.remote import zenoh
from estune.trial import Outcome, TrialRequest
from estune.trial.tracking import tracking_profile
from plants.effects import CoulombFriction
from plants.emulator import RIG_FILE
from tests.serve_rig import hosted
from tests.test_compensation import friction_table, rig_with, trial
from tests.test_remedies import GAINS, found

HIDDEN, COMPENSATION = friction_table("Coulomb, large", 0.8)
TABLES = {"friction": COMPENSATION["friction"]}
PATCH = Patch("coulomb_friction", "feed friction forward", "", TABLES)
REEL = plants.reference_reel() + CoulombFriction(0.08)


ON = PATCH.compensation("", on=True)


def patch(**changes):
    return replace(PATCH, tables={"friction": TABLES["friction"] | changes})


def test_proof_on_the_loop_ends_in_a_sentence_with_intervals():
    with rig_with(effects=[HIDDEN], take_up_A=1.0) as rig:
        rig.apply(GAINS)
        before = rig.describe()
        proof = prove(rig, patch())
        assert rig.describe() == before
    assert proof.proven
    tracking = proof.ratios["tracking"]
    assert 0.3 < tracking.low < tracking.value < tracking.high < 0.7
    assert "slow tracking error 0." in proof.sentence
    assert proof.ratios["rest"].low < 1.2


def test_rig_with_a_remedy_takes_gains_as_the_rig_itself():
    with closing(REEL.rig()) as rig:
        before, other = rig.describe().gains, replace(rig.describe().gains, P=0.5)
        assert other != before
        RemedyRig(rig, PATCH).apply(other)
        assert rig.describe().gains == other


def test_rig_with_a_remedy_asks_for_the_trial_that_it_ran():
    """A rig in another process, that keeps the trials it ran and knows which have failed."""
    with hosted("simulated") as endpoint, zenoh.connect(endpoint) as rig:
        remedied, about = RemedyRig(rig, PATCH), rig.describe()
        request = TrialRequest("asked", 0, about.gains, about.step)
        assert remedied.run(request).outcome is Outcome.DONE
        assert not remedied.has_failed(request)
        assert rig.has_failed(request)  # without the remedy that would be another trial


def test_wrong_sign_is_not_proven():
    """More friction than the drum has, by far: what is fed forward is a disturbance."""
    small = {"name": "coulomb_friction", "torque_Nm": 0.01}
    with rig_with(effects=[small], take_up_A=1.0) as rig:
        rig.apply(GAINS)
        proof = prove(rig, patch(fraction=1.2))
    assert not proof.proven
    assert proof.stopped or proof.ratios["tracking"].low > 1.0


def test_restless_rig_stops_the_proof_and_switches_it_off():
    noisy = {"inertia": {"inertia_kgm2": 2e-3}, "share_max": 0.3}  # oscillates within share_max
    with rig_with() as rig:
        rig.apply(GAINS)
        proof = prove(rig, replace(PATCH, tables=noisy))
        record = trial(rig)
    assert proof.stopped
    assert not proof.proven
    assert "stopped and switched off" in proof.sentence
    assert not record.optional_columns
    assert record.outcome is Outcome.DONE


class ShortTrials:
    """A reel whose rig file allows no trial above 2 s; nothing moves it."""

    def __init__(self):
        self._rig = REEL.rig(gains=GAINS)

    def describe(self):
        about = self._rig.describe()
        return replace(about, limits=replace(about.limits, duration_max_s=2.0))

    def run(self, _request):
        raise AssertionError("it moves before its limits are told")


@pytest.mark.parametrize(
    "begin",
    [
        lambda rig, _: prove(rig, PATCH),
        lambda rig, folder: estune.tune(rig, tracking=True, folder=folder, watch=None),
    ],
    ids=["proof", "tuning"],
)
def test_trials_too_long_for_the_rig_are_told_with_the_key_to_raise_before_motion(begin, tmp_path):
    rig = ShortTrials()
    with pytest.raises(InvalidInput, match=r"raise duration_max_s in the limits .* to \d+$") as no:
        begin(rig, tmp_path)
    needed_s = float(str(no.value).rpartition(" ")[2])
    about = rig.describe()
    enough = replace(about.limits, duration_max_s=needed_s)
    enough.check(tracking_profile(about.step, about.settling_time_s))


@pytest.mark.parametrize("pairs", [-2, 0, 1, 3])
def test_proof_takes_an_even_number_of_pairs(pairs):
    with pytest.raises(InvalidInput, match=f"pairs is {pairs}; give an even number"):
        prove(None, PATCH, pairs=pairs)


class Repeating:
    """Rig whose n-th trial is that of the reel with its tension changed as told."""

    def __init__(self, change):
        self._rig, self._change = REEL.rig(gains=GAINS), change

    def describe(self):
        return self._rig.describe()

    def run(self, request):
        record = self._rig.run(request)
        return replace(record, tension_N=self._change(record.tension_N, request), notch_N=None)

    def close(self):
        self._rig.close()


@pytest.mark.parametrize(("times", "stops"), [(1.3, False), (2.0, True)])
def test_remedy_is_switched_off_where_the_rest_without_it_grows_by_half(times, stops):
    """The sway at rest is small beside the cost, which is about one."""

    def swaying(tension, request):
        on = '"fraction"' in request.compensation
        sway = 0.1 * (times if on else 1.0) * np.sin(np.arange(tension.size))
        return np.convolve(tension, np.ones(9) / 9.0, "same") + sway

    with closing(Repeating(swaying)) as rig:
        proof = prove(rig, PATCH)
    assert bool(proof.stopped) is stops
    assert not stops or "deviates by 0.1" in proof.stopped


def test_turn_with_the_remedy_is_judged_by_the_rest_of_the_turn_without_it(monkeypatch):
    off, taken = dict(zip(trials.MEASURES, np.arange(4.0), strict=True)), []
    monkeypatch.setattr(
        trials, "measured", lambda *given: taken.append(given) or np.array(list(off.values()))
    )
    trials.measured_pair("rig", "about", ("run", 6), "patch")
    assert taken == [
        ("rig", "about", ("run", 6), "patch"),
        ("rig", "about", ("run", 8), "patch", off["rest"]),
    ]


@pytest.mark.parametrize(("table", "is_wide"), [("angle_map", True), ("friction", False)])
def test_triangle_for_what_acts_over_the_drums_angle_turns_the_drum(monkeypatch, table, is_wide):
    limits = []

    def asked(_step, _settling_s, wide):
        limits.append(wide)
        raise InvalidInput("enough")

    monkeypatch.setattr(trials, "tracking_profile", asked)
    patch = SimpleNamespace(tables={table: {}}, compensation=lambda *_, **__: "")
    about = REEL.describe("reel", None)
    with pytest.raises(InvalidInput, match="enough"):
        trials.measured(None, about, ("run", 0), patch)
    assert limits == [about.limits if is_wide else None]


def test_interval_of_a_ratio_is_that_of_students_test_of_the_logarithms(monkeypatch):
    random, turns = np.random.default_rng(1), {True: [], False: []}

    def measured(_rig, _about, _place, _patch, calm_N):
        turn = np.exp(random.normal(-0.5 * (calm_N is not None), 0.05, 4))
        turns[calm_N is not None].append(turn)
        return turn

    monkeypatch.setattr(trials, "measured", measured)
    with closing(REEL.rig(gains=GAINS)) as rig:
        proof = prove(rig, PATCH, pairs=4)
    on, off = np.log(turns[True]), np.log(turns[False])
    expected = ttest_ind(on, off).confidence_interval()
    found = np.array(list(proof.ratios.values()))
    assert found[:, 0] == pytest.approx(np.exp(on.mean(0) - off.mean(0)))
    assert pytest.approx(np.exp(np.array(expected))) == found[:, 1:].T


def test_compensation_of_a_trial_is_on_for_that_trial_alone():
    with rig_with(effects=[HIDDEN], take_up_A=1.0) as rig:
        about = rig.describe()
        first, second, third = (
            rig.run(TrialRequest("c", n, about.gains, about.step, compensation=text))
            for n, text in enumerate(("", ON, ""))
        )
        named = '{"friction": {"file": "/etc/passwd", "tension_per_rad_N": 1.0}}'
        with pytest.raises(InvalidInput, match="own file alone"):
            rig.run(TrialRequest("c", 3, about.gains, about.step, compensation=named))
    assert first.friction_A is None
    assert np.abs(second.friction_A).max() == pytest.approx(0.8 * 0.08 / 0.5, rel=1e-6)
    assert third.friction_A is None
    assert np.std(third.tension_N[-300:]) <= 2.0 * np.std(first.tension_N[-300:])


def test_simulated_rig_feeds_forward_what_the_loop_does():
    with rig_with(effects=[HIDDEN], take_up_A=1.0) as rig:
        about = rig.describe()
        about_loop = rig.run(TrialRequest("c", 0, GAINS, about.step, compensation=ON))
    with closing(REEL.rig()) as rig:
        record = rig.run(TrialRequest("c", 0, GAINS, about.step, compensation=ON))
        text = json.dumps({"known_motion": {"inertia_kgm2": 1e-3}})
        with pytest.raises(InvalidInput, match="is simulated"):
            rig.run(TrialRequest("c", 1, GAINS, about.step, compensation=text))
    # From the step on: before it the loop has come to the preload, with a direction.
    moved = about.step.step_index(632.0) + 20
    np.testing.assert_allclose(
        record.friction_A[moved:], about_loop.friction_A[moved:], rtol=1e-6, atol=1e-9
    )


def test_proof_over_the_link_by_one_command(tmp_path, capsys):
    diagnosis, _ = written(tmp_path, found(CoulombFriction(0.08)))
    path = tmp_path / "coulomb_friction.remedy.json"
    with closing(REEL.rig(gains=GAINS)) as rig, zenoh.serve(rig, "tcp/127.0.0.1:0") as server:
        for told in (diagnosis, path):
            assert run(["prove", str(told), server.endpoint, "--yes", "--trials", "0"]) == 0
        assert rig.describe().gains == GAINS
    assert "PROVEN: " in capsys.readouterr().out
    proven = read_patch(path)
    assert proven.proven
    assert "proven on rig" in proven.status


def written(tmp_path, d):
    diagnosis = tmp_path / "diagnosis.json"
    diagnosis.write_text(json.dumps(d.to_json(), default=str))
    rig = tmp_path / "my-rig.toml"
    rig.write_text(RIG_FILE.read_text())
    return diagnosis, rig


def test_patch_is_written_read_and_applied_never_unasked(tmp_path, capsys):
    diagnosis, rig = written(tmp_path, found(CoulombFriction(torque_Nm=0.05)))
    before = rig.read_text()
    assert run(["remedy", str(diagnosis), "--rig", str(rig)]) in (None, 0)
    told = capsys.readouterr().out
    assert "+[compensation.friction]" in told
    assert "+coulomb_Nm = 0.05" in told
    assert re.search(r"predicted +cost [\d.]+ \[[\d.]+, [\d.]+\], tracking 0\.", told)
    file = tmp_path / "coulomb_friction.remedy.json"
    assert rig.read_text() == before
    assert run(["apply", str(file), str(rig)]) == InvalidInput.exit_code  # nobody confirms
    assert rig.read_text() == before
    assert "not proven" in capsys.readouterr().out
    assert run(["apply", str(file), str(rig), "--yes"]) in (None, 0)
    assert rig.read_text().startswith(before.rstrip("\n"))
    assert tomllib.loads(rig.read_text())["compensation"]["friction"]["fraction"] == 0.8
    assert read_config(rig).compensations().friction.friction.coulomb_Nm == 0.05
    with pytest.raises(InvalidInput, match=r"has a table \[compensation.friction\] already"):
        read_patch(file).applied(rig)


def test_proof_is_kept_and_never_overwritten_by_other_numbers(tmp_path, capsys):
    diagnosis, rig = written(tmp_path, found(CoulombFriction(torque_Nm=0.05)))
    file = tmp_path / "coulomb_friction.remedy.json"
    proof = {"rig": "r", "date": "today", "sentence": "cost 0.8 of what it was", "proven": True}
    replace(patch_of(diagnosis), proof=proof).write(file)
    assert run(["remedy", str(diagnosis), "--rig", str(rig)]) in (None, 0)
    assert read_patch(file).proven
    proven = file.read_text()
    diagnosis, rig = written(tmp_path, found(CoulombFriction(torque_Nm=0.06)))
    for words in (["remedy", str(diagnosis), "--rig", str(rig)], ["prove", str(diagnosis), "x"]):
        assert run(words) == InvalidInput.exit_code
        assert "proven on rig r" in capsys.readouterr().err
    assert file.read_text() == proven


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (CoulombFriction(torque_Nm=2e-4), "less than 2 %"),
        (plants.effects.CurrentLag(), "workshop"),
    ],
)
def test_what_is_not_offered_is_told_with_its_reason(tmp_path, effect, words):
    diagnosis, _ = written(tmp_path, found(effect))
    with pytest.raises(InvalidInput, match=words):
        patch_of(diagnosis)


def test_uncertain_remedy_is_refused_with_the_experiment(tmp_path):
    diagnosis, _ = written(tmp_path, found(CoulombFriction(torque_Nm=0.05), spread=0.5))
    with pytest.raises(InvalidInput, match="slow reversals"):
        patch_of(diagnosis)


def test_remedy_outside_the_gauge_needs_a_gauge_there():
    eyelet = {"attenuation": 0.9, "memory_rad": 0.1, "fraction": 0.8, "tension_per_rad_N": 100.0}
    with (
        closing(REEL.rig(gains=GAINS)) as rig,
        pytest.raises(InvalidInput, match="no gauge outside its eyelet"),
    ):
        prove(rig, replace(PATCH, tables={"eyelet": eyelet}))


def test_number_that_is_not_finite_is_no_remedy():
    with pytest.raises(InvalidInput, match=r"friction\.coulomb_Nm of the remedy is nan"):
        patch(coulomb_Nm=math.nan)
    with pytest.raises(InvalidInput, match=r"friction\.factors of the remedy is inf"):
        patch(factors=[1.0, math.inf])


OTHER = {"inertia": {"inertia_kgm2": 1e-3}}


@pytest.mark.parametrize(
    ("own", "on", "off"),
    [
        ({}, TABLES, None),
        (TABLES, None, {}),
        (OTHER, OTHER | TABLES, None),
        (OTHER | TABLES, None, OTHER),
        (OTHER | {"friction": {}}, OTHER | TABLES, OTHER),
        (TABLES | {"share_max": 0.3}, None, {}),
        ({"velocity": {}}, TABLES | {"velocity": {}}, None),
    ],
)
def test_trial_has_the_remedy_on_or_off_beside_all_others_of_the_rig(own, on, off):
    """None where the rig's own compensations are right."""
    text = json.dumps(own) if own else ""
    for is_on, expected in ((True, on), (False, off)):
        found = PATCH.compensation(text, on=is_on)
        assert (json.loads(found) if found else None) == expected
    assert PATCH.is_on(text) is (on is None)


def test_tables_may_have_words_and_whole_numbers():
    assert patch(file="map.csv", order=3, factors=[1.0, 2.0]).tables["friction"]["order"] == 3


def test_remedy_that_no_rig_has_proven_is_not_taken_for_one(tmp_path):
    file = tmp_path / "x.remedy.json"
    proof = {"rig": "r", "date": "today", "sentence": "cost unchanged", "proven": False}
    for told, kept in (("not proven on any rig", None), ("not proven on rig r, today", proof)):
        replace(PATCH, proof=kept).write(file)
        with pytest.raises(InvalidInput, match=told):
            read_proven(file)
    proven = replace(PATCH, proof=proof | {"proven": True})
    proven.write(file)
    assert read_proven(file) == proven
    assert proven.status == "proven on rig r, today: cost unchanged"


def test_remedy_is_written_over_one_of_other_numbers_that_has_no_proof(tmp_path):
    file, other = tmp_path / "x.remedy.json", patch(coulomb_Nm=0.2)
    assert other.with_proof_of(file) == other
    PATCH.write(file)
    assert other.with_proof_of(file) == other


def test_remedy_of_the_effect_asked_for_is_taken_whatever_is_predicted(tmp_path):
    file = tmp_path / "diagnosis.json"
    kept = {"title": "t", "harm": "", "tables": TABLES, "refused": "", "ratios": {}}
    offers = [{"effect": name, "worth": name == "best", **kept} for name in ("last", "best")]
    file.write_text(json.dumps({"remedies": offers}))
    assert [patch_of(file, effect).effect for effect in (None, "last", "best")] == [
        *("best", "last", "best")
    ]
    with pytest.raises(InvalidInput, match="it has no remedy for another"):
        patch_of(file, "another")


@pytest.mark.parametrize("text", ["", "[]", '{"version": 2}', '{"version": 1, "x": 1}'])
def test_file_that_is_no_patch_is_refused(tmp_path, text):
    path = tmp_path / "x.remedy.json"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"x\.remedy\.json"):
        read_patch(path)
    with pytest.raises(InvalidInput, match=r"x\.remedy\.json"):
        patch_of(path)


def ratios(**values):
    even = {
        name: MeasuredRatio(1.0, 0.99, 1.01) for name in ("cost", "tracking", "reversal", "rest")
    }
    return even | {name: MeasuredRatio(*value) for name, value in values.items()}


@pytest.mark.parametrize(
    ("measured", "proven"),
    [
        ({"tracking": (0.56, 0.54, 0.58)}, True),
        ({"tracking": (0.97, 0.93, 1.01)}, False),
        ({"cost": (0.96, 0.95, 0.97)}, True),
        ({"reversal": (0.98, 0.97, 0.99)}, False),
        ({"tracking": (0.56, 0.54, 0.58), "rest": (1.04, 1.03, 1.05)}, False),
        ({"tracking": (0.56, 0.54, 0.58), "rest": (1.02, 1.01, 1.03)}, True),
        ({"tracking": (0.56, 0.54, 0.58), "cost": (1.1, 1.05, 1.15)}, False),
        ({"rest": (0.5, 0.4, 0.6)}, False),
    ],
)
def test_proven_is_a_gain_beyond_its_interval_and_no_loss(measured, proven):
    assert Proof("r", "today", GAINS, 2, ratios(**measured)).proven is proven


def test_sentence_of_a_proof_says_of_each_measure_whether_its_interval_decides():
    measured = ratios(tracking=(0.56, 0.54, 0.58), reversal=(1.0, 0.9, 1.2), rest=(0.9, 0.85, 1.0))
    assert Proof("r", "today", GAINS, 2, measured).sentence.split("; ") == [
        "cost unchanged",
        "slow tracking error 0.56 [0.54, 0.58] of what it was",
        "error at reversals undecided, 1.00 [0.90, 1.20] of what it was",
        "restlessness undecided, 0.90 [0.85, 1.00] of what it was",
    ]


def test_proof_that_was_stopped_proves_nothing_and_a_tuning_with_it_is_told():
    better = ratios(tracking=(0.56, 0.54, 0.58))
    stopped = Proof("r", "today", GAINS, 2, better, "it hunts")
    assert (stopped.proven, stopped.sentence) == (False, "stopped and switched off: it hunts")
    tuned = Proof("r", "today", GAINS, 2, better, tuned=(1.25, 0.75))
    assert tuned.sentence.endswith("; tuned with it on, the cost falls from 1.25 to 0.75")


def test_rig_with_a_remedy_passes_on_what_is_asked_of_the_rig():
    asked = []

    class Plain:
        def __getattr__(self, name):
            return lambda *given: asked.append((name, *given)) or REEL.describe("reel", GAINS)

    rig = RemedyRig(Plain(), PATCH)
    rig.apply(GAINS)
    rig.abort()
    rig.estop("smoke")
    rig.clear()
    assert asked[1:] == [("apply", GAINS), ("abort",), ("estop", "smoke"), ("clear",)]
    about = REEL.describe("reel", GAINS)
    with closing(REEL.rig(gains=GAINS)) as simulated:  # which remembers no trial
        request = TrialRequest("asked", 0, about.gains, about.step)
        assert not RemedyRig(simulated, PATCH).has_failed(request)


def test_rig_that_ignores_the_remedy_is_found_out():
    class Deaf:
        def __init__(self, rig):
            self._rig = rig

        def describe(self):
            return self._rig.describe()

        def run(self, request):
            return self._rig.run(replace(request, compensation=""))

    with (
        closing(REEL.rig(gains=GAINS)) as rig,
        pytest.raises(RigError, match="without the remedy"),
    ):
        prove(Deaf(rig), patch())


def test_patch_of_a_diagnosis_says_for_which_gains_it_was_predicted(tmp_path):
    gains = {"P": 0.4, "I": 12.0, "D": 0.01, "setpoint_filter_s": 0.03}
    offer = {"effect": PATCH.effect, "title": PATCH.title, "harm": "", "tables": TABLES}
    offer |= {"worth": True, "refused": "", "ratios": {}, "gains": gains}
    file = tmp_path / "d.json"
    file.write_text(json.dumps({"remedies": [offer]}))
    patch = patch_of(file)
    file.write_text(json.dumps({"remedies": [offer | {"gains": None}]}))
    assert patch_of(file) == replace(patch, gains={})
    patch.write(tmp_path / "a.remedy.json")
    assert read_patch(tmp_path / "a.remedy.json").gains == gains
    first = json.loads((tmp_path / "a.remedy.json").read_text()) | {"version": 1}
    del first["gains"]
    file.write_text(json.dumps(first))
    assert read_patch(file).gains == {}
