"""Which deliberate faults of a rig do the conformance suite and `estune doctor --move` find?

Command: `python -m experiments.faulty_rigs`.
Target: the sound rig passes, and every fault is found but the one that shows in no message.

A simulated reel is served with one fault after the other. The suite tests it up to the first
failure; `estune doctor --move` checks those that pass. Without a fault both must pass. Printed is
what found each fault: the test or check that failed.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from estune.support.child_process import child_process, next_line
from experiments.faulty_rigs.faults import FAULTS, MISSED_ONCE
from experiments.results import at_least, command_line, print_results

NONE = "no fault"
UNFOUND = "a trial moves the rig twice"
"""Nothing on the link shows it; see docs/how-to/extend.md."""


@contextmanager
def served(fault: str) -> Iterator[str]:
    """The reel with a fault; yields its endpoint."""
    quiet = {"stderr": subprocess.DEVNULL}
    with child_process("experiments.faulty_rigs.served", fault, **quiet) as process:
        yield next_line(process)


def failed_test(endpoint: str) -> str:
    """The first test of the suite that fails; empty if all pass."""
    suite = [sys.executable, "-m", "estune.conformance", "--endpoint", endpoint, "-x", "-q"]
    done = subprocess.run(suite, capture_output=True, text=True, check=False)  # noqa: S603
    found = re.search(r"^(?:FAILED|ERROR) \S*::(?:test_)?(\w+)", done.stdout, re.MULTILINE)
    return "" if done.returncode == 0 else found[1].replace("_", " ") if found else "the suite"


def failed_check(endpoint: str) -> str:
    """The first check of `estune doctor --move` that fails; empty if all pass."""
    checks = [sys.executable, "-m", "estune", "doctor", endpoint, "--move", "--json"]
    done = subprocess.run(checks, capture_output=True, text=True, check=False)  # noqa: S603
    if not done.stdout:
        return done.stderr.strip()
    findings = json.loads(done.stdout)["findings"]
    return next((f["check"] for f in findings if f["state"] == "fix"), "")


def found_by(fault: str) -> tuple[str, str]:
    """The test of the suite, or the check of the doctor, that finds a fault."""
    with served(fault) as endpoint:
        test = failed_test(endpoint)
        check = "" if test else failed_check(endpoint)
    return test, check


def main() -> int:
    """Runs the experiment."""
    options = _options()
    faults = (NONE, *(MISSED_ONCE if options.quick else FAULTS))
    found = {fault: found_by(fault) for fault in faults}
    sound = not any(found.pop(NONE))
    for fault, (test, check) in () if options.json else found.items():
        print(f"{fault:<40} {test or (check and f'doctor: {check}') or 'NOT FOUND'}")
    by_suite = sum(bool(test) for test, _ in found.values())
    by_doctor = sum(bool(check) for _, check in found.values())
    missed = sorted(fault for fault, who in found.items() if not any(who))
    figures = {"faults": len(found), "by_suite": by_suite, "by_doctor": by_doctor}
    targets = {
        "passes_without_fault": at_least(float(sound), 1.0),
        "found": at_least(by_suite + by_doctor, len(found) - (UNFOUND in missed)),
    }
    return print_results(figures, targets, as_json=options.json)


def _options() -> argparse.Namespace:
    parser = command_line(__doc__, quick="only the eight faults that an earlier suite missed")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
