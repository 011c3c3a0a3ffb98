"""What trials have come to, as moves of the supervision."""

import math

from estune.core.control_chart import Sign
from estune.daemon.events import Kind
from estune.daemon.supervised_rig import Supervision
from estune.daemon.supervisor_state import GainSet, Happening
from estune.daemon.tuning_runs import Decision


def decide(supervision: Supervision, decision: Decision, *, accept: bool) -> None:
    """Takes up what a search came to: better gains are accepted, or wait for a decision."""
    said, better = decision.sentence, decision.better

    def write() -> None:
        supervision.searches.end()
        charts = {
            supervision.life.home: decision.start_chart,
            GainSet.CANDIDATE: decision.chart,
        }
        supervision.checks.set_charts(charts)
        if better is not None:
            supervision.store.set_gains(GainSet.CANDIDATE, better, said)
            if accept:
                supervision.accept(better, said)

    if better is None:
        if decision.start_chart is None:
            unsafe(supervision, f"repeats of the live gains were unsafe; {said}")
            return
        supervision.happen(Happening.KEPT, said, Kind.KEPT, write)
    elif accept:
        supervision.happen(Happening.ADOPTED, said, Kind.BETTER, write, gains=str(better))
    else:
        supervision.happen(Happening.PROPOSED, said, Kind.BETTER, write, gains=str(better))


def unsafe(supervision: Supervision, said: str) -> None:
    """The live gains are not safe: back to the original ones, until somebody has looked."""

    def write() -> None:
        supervision.store.set_gains(GainSet.CANDIDATE, None)
        supervision.store.set_gains(GainSet.ACCEPTED, None)
        supervision.searches.end()

    supervision.happen(Happening.UNSAFE, said, Kind.UNSAFE, write)


def drifted(supervision: Supervision, cost: float, sign: Sign) -> None:
    """Takes up that the cost has left its chart: tunes again, unless that was done only just."""
    if math.isinf(cost):
        home = supervision.life.home
        unsafe(supervision, f"two check trials of the {home} gains in a row were unsafe")
    elif supervision.checks.rested:
        supervision.happen(Happening.DRIFTED, f"{sign.sentence}; tuning again", Kind.DRIFTED)
