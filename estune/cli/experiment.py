"""`estune run-experiment`: one trial from a file, and its record into a folder."""

from pathlib import Path

from rich.text import Text

from estune.cli import output
from estune.cli.values import security_from
from estune.run.export import write_record
from estune.run.targets import open_target
from estune.run.trial_file import read_trial, run_trial
from estune.trial import Outcome

DATA = Path("data")


def run_experiment(
    file: Path,
    target: str,
    /,
    *,
    data: Path = DATA,
    rig: str | None = None,
    security: Path | None = None,
) -> None:
    """Run the trial of a file on a rig, and add its record to a folder of records.

    Args:
        file: The trial, as estune explain writes it: NAME.trial.json.
        target: Where the rig is: an endpoint such as tcp/127.0.0.1:7447, a model file such as
            reel.toml, or module:attribute such as plants:reference_reel.
        data: Folder for the record; made if it is missing.
        rig: Name of the rig, where several answer at the endpoint.
        security: File that says who this is, where the rig asks; see docs/security.md.

    Raises:
        InvalidInput: the file holds no trial, or the rig's limits do not allow it.
    """
    trial = read_trial(file)
    with open_target(target, rig, security_from(security)) as the_rig:
        record = run_trial(the_rig, trial)
    path = write_record(record, data)
    good = record.outcome is Outcome.DONE
    said = record.outcome.sentence if good else record.reason or record.outcome.sentence
    output.console().print(
        Text(f"{record.trial_id}: {said}", style="bold green" if good else "bold yellow")
    )
    output.show_next({"record": path, "samples": record.time_s.size, "rig": record.rig})
