"""`estune run-experiment`: one trial from a file; its record goes into a folder."""

from pathlib import Path

from estune.cli import output
from estune.cli.values import RigName, SecurityFile, security_from
from estune.run.results.export import write_record
from estune.run.targets import open_target
from estune.run.trial_file import read_trial, run_trial
from estune.trial import Outcome


def run_experiment(
    file: Path,
    target: str,
    /,
    *,
    data: Path = Path("data"),
    rig: RigName = None,
    security: SecurityFile = None,
) -> None:
    """Run the trial of a file on a rig, and add its record to a folder of records.

    Args:
        file: The trial, as estune explain writes it: NAME.trial.json.
        target: The rig: an endpoint such as tcp/127.0.0.1:7447, a model file such as reel.toml,
            or module:attribute such as plants:reference_reel.
        data: Folder for the record; made if it is missing.

    Raises:
        InvalidInput: the file holds no trial, or the rig's limits do not allow it.
    """
    trial = read_trial(file)
    with open_target(target, rig, security_from(security)) as the_rig:
        record = run_trial(the_rig, trial)
    path = write_record(record, data)
    done = record.outcome is Outcome.DONE
    sentence = record.outcome.sentence if done else record.reason or record.outcome.sentence
    output.show_outcome(f"{record.trial_id}: {sentence}", good=done)
    output.show_next({"record": path, "samples": record.time_s.size, "rig": record.rig})
