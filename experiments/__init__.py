"""One short runnable file per question: `python -m experiments.NAME`."""
