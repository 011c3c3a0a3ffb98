"""`python -m estune.cli`: the command line without its script, for child processes."""

from estune.cli import main

main()
