"""What a page may do with a stored run: label it, and delete it once that is confirmed."""

import json
import os
import shutil
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from estune.errors import InvalidInput
from estune.run.journal import being_written
from estune.run.labels import Labels, write_labels

NOTES = "actions.jsonl"
"""File in the folder of runs to which each action adds a line."""


STORED = ("label", "delete")
"""The actions on a run that need no rig."""


def run_actions(run: Path, rig: str) -> dict[str, Callable[[str, Mapping[str, Any]], str]]:
    """The actions on a run by name."""
    return {"label": partial(_label, run, rig), "delete": partial(_delete, run, rig)}


def note_action(folder: Path, rig: str, name: str, who: str, sentence: str) -> str:
    """Adds a line on an action to the notes of a folder of runs; returns when it was."""
    at = datetime.now().astimezone().isoformat(timespec="milliseconds")
    note = {"at": at, "who": who, "rig": rig, "action": name, "sentence": sentence}
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / NOTES).open("a", encoding="utf-8") as file:
        file.write(json.dumps(note) + "\n")
        file.flush()
        os.fsync(file.fileno())
    return at


def _label(run: Path, rig: str, who: str, given: Mapping[str, Any]) -> str:
    tags = dict.fromkeys(filter(None, map(str.strip, str(given.get("tags", "")).split(","))))
    write_labels(run, Labels(tuple(tags), str(given.get("note", "")).strip()))
    shown = ", ".join(tags) or "no tags"
    note_action(run.parent, rig, "label", who, f"run {run.name} has new labels: {shown}")
    return "tags and note are stored"


def _delete(run: Path, rig: str, who: str, given: Mapping[str, Any]) -> str:
    """Deletes a run whose name is repeated as a confirmation."""
    if given.get("confirmed") != run.name:
        raise InvalidInput(f"to delete run {run.name}, confirm its name")
    if being_written(run):
        raise InvalidInput(f"run {run.name} is running; stop it first")
    note_action(run.parent, rig, "delete", who, f"run {run.name} is deleted")
    try:
        shutil.rmtree(run)
    except OSError as error:
        raise InvalidInput(f"{run} cannot be deleted: {error.strerror or error}") from error
    return f"run {run.name} is deleted"
