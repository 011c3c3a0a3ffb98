"""Whether a rig is fit to be tuned: what is fine, what must be mended, and how.

Each check is a function from evidence to a finding; `examine` gathers the evidence. Nothing moves
unless the caller has said that it may.
"""

from estune.cli.checks.check_result import CheckResult, State
from estune.cli.checks.run_checks import REPEATS, gentle_trial, run_checks

__all__ = ["REPEATS", "CheckResult", "State", "gentle_trial", "run_checks"]
