"""Commands of the experiments; `COMMANDS` adds them to the command line."""

COMMANDS = (
    (
        "reproduce-paper",
        "experiments.paper.command:reproduce_paper",
        "Reproduce the paper's figures and check its claims.",
        220,
    ),
)
"""Name, function, help, and place in the list of commands (see `estune.cli`)."""
