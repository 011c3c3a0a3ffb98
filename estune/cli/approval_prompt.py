"""Approval, on the terminal, of gains outside the region shown to be safe."""

import sys

from estune.errors import InvalidInput
from estune.run.approval import Answer, ApprovalCallback, ApprovalRequest

_ANSWERS: dict[str, Answer] = {"y": "yes", "n": "no", "a": "always"}


def terminal_approval() -> ApprovalCallback:
    """Approval callback that prompts on the terminal.

    Raises:
        InvalidInput: standard input is not a terminal.
    """
    if not sys.stdin.isatty():
        raise InvalidInput("--ask needs a terminal for its prompt; use one, or leave out --ask")
    return _prompt


def _prompt(question: ApprovalRequest) -> Answer:
    expected = question.prediction
    print(
        f"trial {question.request.number} tests gains outside the region shown to be safe: "
        f"{question.request.gains}\n"
        f"predicted cost: {expected.cost:.3g} ({expected.low:.3g} to "
        f"{expected.high:.3g}); it is unsafe above {question.eta_max:.3g}",
        flush=True,
    )
    while True:
        try:
            text = input("run it? yes, no, or always (yes from here on): ")
        except EOFError:
            raise KeyboardInterrupt from None  # the terminal has closed: stop, as by Ctrl-C
        answer = _ANSWERS.get(text.strip().lower()[:1])
        if answer is not None:
            return answer
