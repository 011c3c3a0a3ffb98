"""Commands for simulated plants and their models; `COMMANDS` adds them to the command line."""

COMMANDS = (
    ("demo", "plants.commands.demo:demo", "Tune a simulated reel over Zenoh.", 10),
    ("serve", "plants.commands.serve:serve", "Serve a simulated plant as a rig.", 160),
    (
        "bench",
        "plants.commands.bench:bench",
        "Measure the force felt at a reel's cable while its end moves.",
        172,
    ),
    (
        "explain",
        "plants.commands.explain:explain",
        "Identify the effect missing from a model, from records.",
        130,
    ),
    (
        "explain-page",
        "plants.commands.explain_page:explain_page",
        "Explain records in the browser: columns, model, verdict.",
        131,
    ),
    (
        "records",
        "plants.commands.records:records",
        "Show how recorded data are understood, and convert them.",
        125,
    ),
    (
        "improve-model",
        "plants.commands.improve_model:improve_model",
        "Improve a rig's model by experiment, then tune the rig.",
        150,
    ),
)
"""Name, function, help, and place in the list of commands (see `estune.cli`)."""
