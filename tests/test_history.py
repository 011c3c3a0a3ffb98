"""Results of finished runs whose tuner has changed."""

import pytest

from estune import api
from estune.errors import JournalError
from estune.run.journal import Journal
from estune.tuners import TUNERS
from tests.support_lanes import first_by_day
from tests.support_runs import ArithmeticRig

TUNE = {"tuner": "phase_compensated", "trials": 40, "repeats": 2, "run": "old", "watch": None}


@pytest.fixture(params=["other gains", "no such tuner"])
def another_version(monkeypatch, request):
    """Changes the tuners' proposals, or makes the stored tuner unknown."""

    def proposes(_):
        for kind in (TUNERS[name].kind for name in ("phase_compensated", "safe_bayesian")):

            def ask(self, state, proposal=kind.ask):
                return tuple(1.01 * value for value in proposal(self, state))

            monkeypatch.setattr(kind, "ask", ask)

    def gone(folder):
        with Journal.open(folder, write=True) as journal:
            plan = journal.fact("plan")
            plan["tuner"]["kind"] += "OfOld"
            journal.note(plan=plan)

    return {"other gains": proposes, "no such tuner": gone}[request.param]


@pytest.mark.parametrize("tuner", first_by_day("phase_compensated", "safe_bayesian"))
def test_finished_run_loads_although_its_tuner_has_changed(tmp_path, another_version, tuner):
    then = api.tune(ArithmeticRig(), folder=tmp_path, **TUNE | {"tuner": tuner, "trials": 90})
    another_version(tmp_path / "old")
    now = api.load(tmp_path / "old")
    assert then.success
    assert bool(then.verdict.intervals) == (tuner == "safe_bayesian")
    assert now.verdict == then.verdict
    assert now.rows() == then.rows()
    assert now.remarks() == then.remarks()
    assert now.to_frame().equals(then.to_frame())


def test_unfinished_run_is_refused_after_its_tuner_has_changed(tmp_path, another_version):
    class Failing(ArithmeticRig):
        def run(self, request):
            if request.number == 20:
                raise KeyboardInterrupt
            return super().run(request)

    with pytest.raises(KeyboardInterrupt):
        api.tune(Failing(), folder=tmp_path, **TUNE)
    another_version(tmp_path / "old")
    for look in (api.load, lambda folder: api.resume(folder, ArithmeticRig(), watch=None)):
        with pytest.raises(JournalError, match="version"):
            look(tmp_path / "old")
