"""Step 2: records that no model could explain are refused, each with the reason."""

from typing import Any

from plants.diagnosis.checks import quality
from plants.diagnosis.data.records import FolderContents


def check(logged: FolderContents, model: Any) -> FolderContents:
    """The measurements that can be used, with the issues of the files and of the data.

    Raises:
        InvalidInput: none is left; the message says why for each.
    """
    usable, issues = quality.check(logged.measurements, model)
    return FolderContents(usable, (*logged.findings, *issues))
