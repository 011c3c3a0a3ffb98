"""`python -m estune.cli`, for a process that starts another one of its own kind."""

from estune.cli import main

main()
