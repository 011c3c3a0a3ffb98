"""Runs an experiment in its own process."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any


def run_experiment(name: str, folder: Path, *options: str) -> dict[str, Any]:
    """The figures and targets that an experiment prints; it may take as long as it needs."""
    command = [sys.executable, "-m", f"experiments.{name}", "--json", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    return json.loads(done.stdout)
