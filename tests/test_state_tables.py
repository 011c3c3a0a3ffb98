"""Every state machine has one table, with a function or a reason for each event in each mode."""

import inspect
from itertools import product

import pytest

from estune.core.gains import Gains
from estune.daemon import supervisor_state
from estune.daemon.supervisor_state import SupervisorEvent, SupervisorMode
from estune.hardware.loop_messages import BeginTrial
from estune.hardware.reel_machine import transitions
from estune.hardware.reel_machine.transitions import MotionEvent
from estune.hardware.shared_memory import MotionPhase, SensorLevels
from estune.reel.guard import GuardTrip, Reason
from estune.remote.state_machine import client, events, rig, trials
from estune.remote.state_machine.client import ClientInput, ClientStage
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.remote.state_machine.trials import TrialEvent, TrialState
from estune.support.state_table import StateTable
from estune.trial import Outcome
from estune.trial.profiles import StepProfile
from tests import state_tables
from tests.support_hardware import VirtualLoop, config

MACHINES = {
    "rig": (rig.TABLE, events.Event.__args__, Mode),
    "trial": (trials.TABLE, TrialEvent, TrialState),
    "client": (client.TABLE, {*ClientInput, *ReplyCode}, ClientStage),
    "supervisor": (supervisor_state.TABLE, SupervisorEvent, SupervisorMode),
    "reel": (transitions.TABLE, MotionEvent, MotionPhase),
}


@pytest.mark.parametrize("name", MACHINES)
def test_table_has_a_function_or_a_reason_for_every_event_in_every_mode(name):
    table, inputs, modes = MACHINES[name]
    assert isinstance(table, StateTable)
    assert set(table.rows) == set(inputs)
    for event, mode in product(inputs, modes):
        cell = table.cell(event, mode)
        assert callable(cell) or (isinstance(cell, str) and cell), (event, mode)
        sentence = state_tables.sentence_of(cell)
        assert sentence, (event, mode)
        assert isinstance(cell, str) or len(sentence.split()) <= 20, sentence


@pytest.mark.parametrize("name", MACHINES)
def test_functions_of_an_event_take_the_same_arguments(name):
    table = MACHINES[name][0]
    for event, row in table.rows.items():
        functions = [cell for cell in row.values() if not isinstance(cell, str)]
        counts = {len(inspect.signature(function).parameters) for function in functions}
        assert len(counts) <= 1, event


PHASES = "off take_up hold trial ramp stopped"
AFTER = {
    MotionEvent.BEGIN: "take_up take_up hold trial take_up take_up",
    MotionEvent.SET_GAINS: PHASES,
    MotionEvent.CLEAR: PHASES,
    MotionEvent.STOP: "off ramp ramp ramp ramp stopped",
    MotionEvent.ABORT: "off take_up hold hold ramp stopped",
    MotionEvent.SETPOINTS: "take_up take_up hold trial ramp take_up",
    MotionEvent.TRIP: "off ramp hold hold ramp stopped",
    MotionEvent.SAMPLE: PHASES,
}
"""Phase of a reel after an event in each of its phases; the heartbeat is lost at a trip."""


def reel_in(phase: MotionPhase):
    """A reel that has come to a phase by samples, with nothing latched, and a trial."""
    loop = VirtualLoop(config(safe__state="hold"))
    request = BeginTrial(
        1, loop.plan.live, 632, open_loop=False, cost_max=float("inf"), duration_s=2.0
    )
    reel = loop.machine._reel
    if phase is not MotionPhase.OFF:
        loop.ask(Gains(1.0, 40.0, 0.015, 0.005), StepProfile(15.0, 10.0, 0.2, 1.0))
        to = phase if phase < MotionPhase.RAMP else MotionPhase.TRIAL
        loop.until(lambda: reel.phase is to)
    if phase >= MotionPhase.RAMP:
        loop.estop(on=True)
        loop.until(lambda: reel.phase is phase)
        loop.estop(on=False)
        loop.machine.reset()
    return reel, request


@pytest.mark.parametrize("event", MotionEvent)
@pytest.mark.parametrize("phase", MotionPhase)
def test_event_brings_a_reel_from_each_phase_to_the_next(event, phase):
    reel, request = reel_in(phase)
    lost = GuardTrip(Reason.HEARTBEAT, "no heartbeat")
    last_s = float(reel.memory.levels[SensorLevels.TIME_s])
    brings = {
        MotionEvent.BEGIN: (request,),
        MotionEvent.SET_GAINS: (request.coefficients,),
        MotionEvent.STOP: (Outcome.CANCELLED, "stop"),
        MotionEvent.TRIP: (lost, 100.0, 15.0),
        # One sample later: the ramp takes its time, so that a longer one ends it.
        MotionEvent.SAMPLE: (
            last_s + 1.0 / 632.0,
            reel.plan.motion.taut_N - 0.1 if phase < 2 else 15.0,
        ),
    }
    cell = transitions.TABLE.cell(event, phase)
    if not isinstance(cell, str):
        cell(reel, *brings.get(event, ()))
    expected = AFTER[event].split()[phase]
    assert reel.phase.name.lower() == expected
    assert reel.latched is (event is MotionEvent.STOP)


def test_page_of_the_tables_is_up_to_date():
    text = state_tables.PAGE.read_text("utf-8")
    assert state_tables.page(text) == text, "run: ./dev python -m tests.state_tables"
