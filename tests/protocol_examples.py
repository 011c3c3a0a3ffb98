"""An example of each message of the rig protocol, for its page and its tests."""

from dataclasses import fields
from typing import Any, get_type_hints

import numpy as np

from estune.remote import messages
from estune.remote.messages import VERBS, Answer, Description, Following, Inquire, Status
from estune.remote.messages.codec import Message
from estune.remote.messages.replies import Failure
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.trial import (
    Feedback,
    Setpoint,
    Telemetry,
)
from experiments.inert_rig import DESCRIBED, GAINS, REQUEST

LEASE = "5ad1e7c0ffee0042"
SAMPLES = Telemetry(
    *(REQUEST.trial_id, 32, 632.0, np.array([15.0, 15.0])),
    *(np.array([14.75, 15.25]), np.array([0.75, 0.5]), np.array([0.0, 0.25])),
)
VALUES: dict[str, Any] = {
    "action": "acquire",
    "lease": LEASE,
    "holder": "anna@lab, process 4711",
    "request": REQUEST,
    "digest": messages.digest(REQUEST),
    "trial_id": REQUEST.trial_id,
    "gains": GAINS,
    "reason": "anna: the cable smokes",
    "sent_s": 4711.25,
    "setpoint": Setpoint(18.5),
    "tables": ("friction",),
}
"""Values of the fields of the example commands, by name; others have those of their type."""
OF_TYPE = {float: 2.5, int: 3, str: "a text", bool: True}


def _example(kind: Any) -> Message:
    hints = get_type_hints(kind)
    made: Message = kind(
        **{f.name: VALUES.get(f.name, OF_TYPE.get(hints[f.name])) for f in fields(kind)}
    )
    return made


COMMANDS: dict[str, Message] = {name: _example(verb.message) for name, verb in VERBS.items()}
EXAMPLES: tuple[Any, ...] = (
    *COMMANDS.values(),
    Inquire(messages.digest(REQUEST), 1024, 1024),
    Following(4711.25, Feedback(86.125, 18.25, -3.5, 0.875)),
    Answer(ReplyCode.HELD, sentence="the rig is held by anna@lab, process 4711"),
    Status("9f3c01aa", Mode.RUNNING, REQUEST.trial_id, 7, "anna@lab, process 4711", ""),
    Description(DESCRIBED, "9f3c01aa", "d1a5c0de00000001"),
    Failure("rig drum: the gauge's cable is broken; check the rig, then start it anew"),
)
