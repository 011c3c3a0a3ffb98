"""Parts that installed packages add to the program, found by entry point.

Groups: `estune.commands` (commands of the command line), `estune.model_files` (readers of model
files, by the ending of the file's name), `estune.examples` (example files, as text).
"""

from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from estune.errors import InvalidInput


def plugins(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group, by name."""
    return {point.name: point for point in entry_points(group=group)}


def load_plugin(point: EntryPoint) -> Any:
    """The object that an entry point names.

    Raises:
        InvalidInput: its package is hidden by another of the same name, or cannot be imported.
    """
    if hint := hiding_hint(point.module):
        raise InvalidInput(hint)
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        raise InvalidInput(
            f"{point.value} cannot be imported ({error}); reinstall its package"
        ) from error


def hiding_hint(module: str) -> str:
    """Why a module is not the installed one, with the remedy; empty if nothing hides it.

    In a session of Python the working directory comes before what is installed.
    """
    package = module.partition(".")[0]
    installed = Path(__file__).parents[2] / package  # beside estune, in the same installation
    spec = find_spec(package)
    if spec is None or not (installed / "__init__.py").is_file():
        return ""
    folders = [Path(folder).resolve() for folder in spec.submodule_search_locations or ()]
    if installed.resolve() in folders:
        return ""
    return (
        f"{spec.origin or folders[0]} hides the installed package {package}; "
        "rename that file or folder, or start in another directory"
    )


def hidden_hint(module: str) -> str:
    """Why a module is the installed one, not the user's of that name; empty if there is no such.

    On the command line what is installed comes first, so that `estune` works beside a `plants.py`.
    """
    own = Path(f"{module.partition('.')[0]}.py")
    found = find_spec(own.stem)
    if not own.is_file() or found is None or found.origin == str(own.resolve()):
        return ""
    return f"{own} here is hidden by the installed package {own.stem}; rename that file"
