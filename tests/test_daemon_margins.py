"""Margins that the daemon watches: a changed plant is noticed, a quiet one is left alone."""

import tomllib
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import control
import pytest

import plants
from estune.core.gains import Gains
from estune.daemon.config import config_from
from estune.daemon.margin_watch import MarginWatch
from estune.errors import Interrupted, InvalidInput
from estune.remote import zenoh
from estune.trial import Outcome
from estune.web.board import Board
from estune.web.server import PageServer
from estune.web.views import RemoteSupervision, View, daemon_view
from experiments.loop_claims.truth import true_sensitivity
from plants.effects import StickingActuator
from tests.support_browser import browser, needs_browser, opened
from tests.support_daemon import daemon, rig_table

GAINS = Gains(0.5, 8.0, 0.007, 0.01)
DITHERED = "margins = {dither = 0.01, every_s = 0.05, dither_time = 1.0}\n"


class ChangingRig:
    """A simulated reel in virtual time, whose drum becomes heavier; a guard may end its trials."""

    def __init__(self) -> None:
        self.plant = plants.reference_reel()
        self._rig = self.plant.rig(name="drum", gains=GAINS, seed=3)
        self.requests = []

    def become(self, plant) -> None:
        other = plant.rig(name="drum", gains=self._rig.describe().gains, seed=4)
        self.plant, self._rig = plant, other

    def run(self, request):
        self.requests.append(request)
        return self._rig.run(request)

    def describe(self):
        return self._rig.describe()

    def apply(self, gains):
        self._rig.apply(gains)

    def abort(self):
        return self._rig.abort()

    def estop(self, reason):
        self._rig.estop(reason)

    def clear(self):
        self._rig.clear()

    def close(self):
        self._rig.close()


@contextmanager
def watched(folder, margins=DITHERED):
    rig = ChangingRig()
    table = rig_table("drum", "{}", accept="auto", trials=8, every_s=3600.0) + margins
    with zenoh.serve(rig) as server, daemon(folder, table.replace("{}", server.endpoint)) as it:
        yield rig, it


def multisines(rig):
    return sum(request.profile.kind == "multisine" for request in rig.requests)


@pytest.mark.slow
def test_a_heavier_drum_is_noticed_within_two_records_and_a_quiet_reel_is_left_alone(tmp_path):
    with watched(tmp_path) as (rig, it):
        status = it.until(lambda s: s.sensitivity is not None and multisines(rig) >= 6)
        low, high = status.sensitivity[1:]
        assert low <= true_sensitivity(rig.plant, status.gains[status.live]) <= high
        assert not {"plant", "drifted", "margins"} & set(it.kinds())
        before = multisines(rig)
        rig.become(replace(rig.plant, drum_inertia_kg_m2=1.3 * rig.plant.drum_inertia_kg_m2))
        it.until(lambda _: "plant" in it.kinds())
        assert multisines(rig) - before <= 3  # one may have been under way
        it.until(lambda s: s.run.endswith("-002"))  # and it is tuned again


@pytest.mark.slow
def test_a_guard_that_ends_a_multisine_ends_them_all(tmp_path):
    with watched(tmp_path) as (rig, it):
        it.until(lambda s: s.sensitivity is not None)
        run, kind = rig.run, "multisine"
        rig.run = lambda request: (
            replace(run(request), outcome=Outcome.GUARD)
            if request.profile.kind == kind
            else run(request)
        )
        it.until(lambda _: "dither" in it.kinds())
        (event,) = [e for e in it.client.events("drum", limit=1000) if e.kind == "dither"]
        assert "until the daemon restarts" in event.sentence


def test_without_dither_the_check_trials_show_the_margins_and_nothing_else_moves(tmp_path):
    with watched(tmp_path, "margins = {every_s = 0.05}\n") as (rig, it):
        it.until(lambda s: s.checks >= 1)
        of_the_tuning = multisines(rig)
        status = it.until(lambda s: s.sensitivity is not None and s.checks >= 8)
        low, high = status.sensitivity[1:]
        assert low <= true_sensitivity(rig.plant, status.gains[status.live]) <= high
        assert multisines(rig) == of_the_tuning


def interval(status):
    Ms, low, high = status.sensitivity
    return f"{Ms:.2f} ({low:.2f} to {high:.2f})"


@needs_browser
def test_page_of_a_supervised_rig_shows_its_margins_with_their_interval(tmp_path):
    with watched(tmp_path, "margins = {every_s = 0.05}\n") as (_, it):
        it.until(lambda s: s.sensitivity is not None)
        views = [daemon_view("drum", RemoteSupervision(it.client, "drum"))]
        server = PageServer(lambda: [*views, View("other", "run", Board(), [])])
        try:
            with browser() as chromium, opened(chromium, server.address) as page:
                facts, row = page.locator("#facts"), page.locator("#views tr", has_text="drum")
                it.until(lambda s: s.sensitivity and s.margins in facts.inner_text())
                it.until(lambda s: s.sensitivity and interval(s) in row.inner_text())
        finally:
            server.close()


def test_dither_of_the_command_line_is_that_of_all_rigs_within_its_budget():
    text = f"[service]\n{rig_table('a', 'plants:reference_reel')}"
    config = config_from(
        tomllib.loads(text + rig_table("b", "plants:reference_reel")), "test", Path()
    )
    assert {rig.margins.dither for rig in config.rig} == {0.0}
    assert {rig.margins.dither for rig in config.with_dither(0.01).rig} == {0.01}
    with pytest.raises(InvalidInput, match=r"dither.*0\.1"):
        config.with_dither(0.5)


def test_multisine_that_was_interrupted_on_a_moving_rig_calls_the_operator():
    text = f"[service]\n{rig_table('drum', 'plants:reference_reel')}{DITHERED}"
    watch = MarginWatch(config_from(tomllib.loads(text), "test", Path()).rig[0], "test")
    rig = ChangingRig()
    run, about = rig.run, replace(rig.describe(), simulated=False)
    rig.run = lambda request: replace(run(request), outcome=Outcome.INTERRUPTED, reason="power")
    with pytest.raises(Interrupted, match=r"power.*check the rig"):
        watch.take(None, rig, about, GAINS)


def test_actuator_that_begins_to_stick_is_reported_and_no_gains_are_offered():
    text = f"[service]\n{rig_table('flow', 'plants:reference_reel')}"
    text += "margins = {dither = 0.1, every_s = 0.001, dither_time = 1.0}\n"
    watch = MarginWatch(config_from(tomllib.loads(text), "test", Path()).rig[0], "test")
    gains = Gains(0.1, 2.0, 0.0, 0.0)
    valve = plants.linear_plant(control.tf([2.0], [0.02, 1.0]), 0.0, 100.0, gains=gains)
    sticks = valve + StickingActuator(band_A=0.03, slip=0.2)
    free, stuck = (plant.rig(name="flow", gains=gains, seed=3) for plant in (valve, sticks))
    *quiet, told = (watch.take(None, rig, rig.describe(), gains) for rig in (free, free, stuck))
    assert quiet == [[], []]
    (report,) = told
    assert "STICKING ACTUATOR" in report.sentence
    assert (report.gains, report.is_machine) == (None, True)
