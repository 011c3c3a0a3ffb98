"""Asks at the terminal before gains are tried beyond what is known to be safe."""

import sys

from estune.errors import InvalidInput
from estune.run.loop import Answer, ApprovalCallback, ApprovalRequest

_ANSWERS: dict[str, Answer] = {"y": "yes", "n": "no", "a": "always"}


def terminal_approval() -> ApprovalCallback:
    """What asks whoever sits at the terminal.

    Raises:
        InvalidInput: nobody does.
    """
    if not sys.stdin.isatty():
        raise InvalidInput("--ask needs a terminal to ask at; run it at one, or leave --ask out")
    return _asked


def _asked(question: ApprovalRequest) -> Answer:
    expected = question.expected
    print(
        f"trial {question.request.number} would leave what is known to be safe: "
        f"{question.request.gains}\n"
        f"its cost is expected at {expected.cost:.3g} ({expected.low:.3g} to "
        f"{expected.high:.3g}); it is unsafe above {question.eta_max:.3g}",
        flush=True,
    )
    while True:
        try:
            said = input("run it? yes, no, or always (yes from here on): ")
        except EOFError:
            raise KeyboardInterrupt from None  # whoever was there has gone: stop, as by Ctrl-C
        answer = _ANSWERS.get(said.strip().lower()[:1])
        if answer is not None:
            return answer
