"""`estune licences`: the licences of what is installed with estune."""

import re
from importlib import metadata

from estune.cli.output import print_json
from estune.cli.values import Json

_NAME = re.compile(r"[A-Za-z0-9._-]+")


def licences(*, json: Json = False) -> None:
    """List the packages that estune needs, directly and indirectly, each with its licence."""
    found = sorted(_installed("estune").items(), key=lambda item: item[0].lower())
    if json:
        print_json({name: {"version": v, "licence": text} for name, (v, text) in found})
        return
    for name, (version, text) in found:
        print(f"{name} {version}: {text}")


def _installed(name: str) -> dict[str, tuple[str, str]]:
    """Version and licence of a distribution, and of all that it requires and that is there."""
    found: dict[str, tuple[str, str]] = {}
    waiting = [name]
    while waiting:
        try:
            about = metadata.distribution(waiting.pop())
        except metadata.PackageNotFoundError:  # an extra that is not installed
            continue
        own = about.metadata["Name"]
        if own not in found:
            found[own] = about.version, _licence(about.metadata)
            needed = about.requires or ()
            if own != name:  # its extras are of its own tests and pages as a rule
                needed = [one for one in needed if "extra ==" not in one]
            waiting += [match[0] for one in needed if (match := _NAME.match(one))]
    return found


def _licence(about: metadata.PackageMetadata) -> str:
    """The licence as an expression, else by the classifiers, else the first line of its text."""
    if "License-Expression" in about:
        return about["License-Expression"]
    classes = [str(one) for one in about.get_all("Classifier") or () if one.startswith("License")]
    named = [one.rpartition(" :: ")[2] for one in classes if one.count(" :: ") > 1]
    first = ([*(about.get_all("License") or ()), ""])[0].strip().partition("\n")[0]
    return ", ".join(named) or first or "not stated; see its files"
