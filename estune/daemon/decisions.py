"""What trials have come to, as moves of the supervision."""

import math

from estune.core.control_chart import ChartSignal
from estune.daemon.events import EventKind
from estune.daemon.supervised_rig import SupervisedRig
from estune.daemon.supervisor_state import GainSet, SupervisorEvent
from estune.daemon.tuning_runs import Decision


def apply_tuning_decision(supervision: SupervisedRig, decision: Decision, *, accept: bool) -> None:
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
            revert_to_original(supervision, f"repeats of the live gains were unsafe; {said}")
            return
        supervision.apply_event(SupervisorEvent.KEPT, said, EventKind.KEPT, write)
    elif accept:
        supervision.apply_event(
            SupervisorEvent.ADOPTED, said, EventKind.BETTER, write, gains=str(better)
        )
    else:
        supervision.apply_event(
            SupervisorEvent.PROPOSED, said, EventKind.BETTER, write, gains=str(better)
        )


def revert_to_original(supervision: SupervisedRig, said: str) -> None:
    """The live gains are not safe: back to the original ones, until somebody has looked."""

    def write() -> None:
        supervision.store.set_gains(GainSet.CANDIDATE, None)
        supervision.store.set_gains(GainSet.ACCEPTED, None)
        supervision.searches.end()

    supervision.apply_event(SupervisorEvent.UNSAFE, said, EventKind.UNSAFE, write)


def handle_drift(supervision: SupervisedRig, cost: float, sign: ChartSignal) -> None:
    """Takes up that the cost has left its chart: tunes again, unless that was done only just."""
    if math.isinf(cost):
        home = supervision.life.home
        revert_to_original(
            supervision, f"two check trials of the {home} gains in a row were unsafe"
        )
    elif supervision.checks.is_cooldown_over:
        supervision.apply_event(
            SupervisorEvent.DRIFTED, f"{sign.sentence}; tuning again", EventKind.DRIFTED
        )
