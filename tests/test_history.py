"""A run can be looked at after its tuner has changed."""

from dataclasses import replace

import pytest

from estune import api
from estune.core.tuners import PhaseCompensated
from estune.errors import JournalError
from tests.support_runs import ArithmeticRig

TUNE = {"tuner": "phase_compensated", "trials": 40, "repeats": 2, "run": "old", "watch": None}


@pytest.fixture
def another_version(monkeypatch):
    """Lets the tuner propose other gains from here on."""
    asked = PhaseCompensated.ask

    def ask(self, state):
        return tuple(1.01 * value for value in asked(self, state))

    return lambda: monkeypatch.setattr(PhaseCompensated, "ask", ask)


def test_what_a_finished_run_came_to_is_recalled_though_its_tuner_has_changed(
    tmp_path, another_version
):
    then = api.tune(ArithmeticRig(), folder=tmp_path, **TUNE)
    another_version()
    now = api.load(tmp_path / "old")
    assert then.success
    assert now.rows() == then.rows()
    assert now.to_frame().equals(then.to_frame())
    known = {"message": "", "intervals": ()}  # what the tuner said and knew is not recalled
    assert replace(now.verdict, **known) == replace(then.verdict, **known)
    assert now.message.startswith(then.message.split(";")[0])


def test_a_run_that_was_not_finished_is_refused_after_its_tuner_has_changed(
    tmp_path, another_version
):
    class Failing(ArithmeticRig):
        def run(self, request):
            if request.number == 20:
                raise KeyboardInterrupt
            return super().run(request)

    with pytest.raises(KeyboardInterrupt):
        api.tune(Failing(), folder=tmp_path, **TUNE)
    another_version()
    for look in (api.load, lambda folder: api.resume(folder, ArithmeticRig(), watch=None)):
        with pytest.raises(JournalError, match="version"):
            look(tmp_path / "old")
