"""Checks of a rig before it is tuned, each with a remedy.

Each check is a function from evidence to a result; `run_checks` gathers the evidence. Nothing
moves unless the caller allows it.
"""

from estune.cli.checks.check_result import CheckResult, State
from estune.cli.checks.file_checks import run_file_checks
from estune.cli.checks.run_checks import REPEATS, gentle_trial, run_checks

__all__ = ["REPEATS", "CheckResult", "State", "gentle_trial", "run_checks", "run_file_checks"]
