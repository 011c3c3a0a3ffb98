"""A remedy as a patch of a rig's file: what it changes, what was predicted, what was proven."""

import difflib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from estune.errors import InvalidInput
from estune.support.file_limits import parse_json
from estune.support.toml_file import read_toml
from estune.support.whole_file import write_file

SUFFIX = ".remedy.json"
VERSION = 2
OLDER = (1,)
"""Versions that are read, too: 1 has no `gains`."""
SWITCH_NOTHING = frozenset(("share_max", "velocity"))
"""Keys of `[compensation]` that switch nothing on."""


@dataclass(frozen=True, slots=True)
class Patch:
    """One remedy in the loop.

    Attributes:
        effect: Slug of the effect that it is against.
        tables: Tables of `[compensation]` that switch it on.
        predicted: Predicted ratios of with to without: value, low and high by measure.
        proof: What the rig measured; see `estune.proof.trials.Proof`. None before.
        gains: Gains that the prediction is for, by name; empty where nothing says them.

    Raises:
        InvalidInput: a number of the tables is not finite.
    """

    effect: str
    title: str
    harm: str
    tables: Mapping[str, Mapping[str, Any]]
    predicted: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    proof: Mapping[str, Any] | None = None
    gains: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, number in _numbers("compensation", self.tables):
            if not math.isfinite(number):
                raise InvalidInput(
                    f"{name} of the remedy is {number}, and must be finite; write the diagnosis "
                    "again by estune explain --json"
                )

    @property
    def proven(self) -> bool:
        """Whether the rig has shown its gain."""
        return self.proof is not None and bool(self.proof["proven"])

    def compensation(self, own: str, *, on: bool) -> str:
        """What a trial's request has for this remedy on or off, beside all others of the rig.

        Returns:
            JSON of the tables, `{}` for none; empty where the rig's own are right.
        """
        there = parse_json(own or "{}")
        wanted = {name: table for name, table in there.items() if name not in self.tables}
        wanted |= self.tables if on else {}
        if wanted == there:
            return ""
        return json.dumps(wanted if set(wanted) - SWITCH_NOTHING else {}, sort_keys=True)

    def is_on(self, own: str) -> bool:
        """Whether the rig's own compensations have it, with the same numbers."""
        return not self.compensation(own, on=True)

    @property
    def status(self) -> str:
        """Whether it is proven, in a sentence."""
        if self.proof is None:
            return "not proven on any rig: run estune prove first"
        state, proof = "proven" if self.proven else "not proven", self.proof
        return f"{state} on rig {proof['rig']}, {proof['date']}: {proof['sentence']}"

    def toml(self) -> str:
        """The tables as text of a rig's file."""
        lines = [f"# against {self.effect}: {self.title}"]
        for name, table in self.tables.items():
            lines.append(f"[compensation.{name}]")
            lines += [f"{key} = {value!r}" for key, value in table.items()]
        return "\n".join(lines) + "\n"

    def applied(self, rig_file: Path) -> str:
        """Text of the rig's file with the tables added at its end.

        Raises:
            InvalidInput: the file cannot be read, or has one of the tables already.
        """
        there = read_toml(rig_file).get("compensation", {})
        for name in self.tables:
            if name in there:
                raise InvalidInput(
                    f"{rig_file} has a table [compensation.{name}] already; take it out, or "
                    f"change its numbers by hand to: {dict(self.tables[name])}"
                )
        text = rig_file.read_text(encoding="utf-8")
        return text.rstrip("\n") + "\n\n" + self.toml()

    def diff(self, rig_file: Path) -> str:
        """The change of the rig's file as a unified diff; see `applied`."""
        before = rig_file.read_text(encoding="utf-8").splitlines(keepends=True)
        after = self.applied(rig_file).splitlines(keepends=True)
        return "".join(difflib.unified_diff(before, after, str(rig_file), str(rig_file)))

    def with_proof_of(self, path: Path) -> Self:
        """This patch, with the proof that a file has of it, if there is one.

        Raises:
            InvalidInput: the file is no patch, or has the proof of other numbers.
        """
        there = read_patch(path) if path.exists() else self
        if there.proof is None:
            return self
        if there.tables != self.tables:
            raise InvalidInput(
                f"{path} has other numbers and is {there.status}; move it to keep that proof"
            )
        return replace(self, proof=there.proof)

    def write(self, path: Path) -> None:
        """Writes the patch, in one step.

        Raises:
            InvalidInput: it cannot be written there.
        """
        text = json.dumps({"version": VERSION, **asdict(self)}, indent=2) + "\n"
        write_file(path, text.encode())


def read_patch(path: Path) -> Patch:
    """The patch in a file.

    Raises:
        InvalidInput: the file cannot be read, or is no patch.
    """
    values = _json(path)
    if not isinstance(values, dict) or values.pop("version", None) not in (VERSION, *OLDER):
        raise InvalidInput(f"{path} is no patch of version {VERSION}; write one by estune remedy")
    try:
        return Patch(**values)
    except TypeError as error:
        raise InvalidInput(f"{path} is no patch: {error}; write one by estune remedy") from error


def read_proven(path: Path) -> Patch:
    """The patch in a file, whose remedy a rig has proven.

    Raises:
        InvalidInput: the file cannot be read, is no patch, or the remedy is not proven.
    """
    patch = read_patch(path)
    if not patch.proven:
        raise InvalidInput(f"{path}: {patch.effect} is {patch.status}")
    return patch


def patch_of(diagnosis: Path, effect: str | None = None) -> Patch:
    """The remedy in the loop that a diagnosis offers.

    Args:
        diagnosis: JSON of `estune explain --json`.
        effect: Slug of the effect, whose remedy is then taken whatever is predicted; None takes
            that of the greatest predicted gain.

    Raises:
        InvalidInput: the file is no diagnosis, or offers none, with the reason for each remedy.
    """
    values = _json(diagnosis)
    if not isinstance(values, dict) or not isinstance(values.get("remedies"), list):
        raise InvalidInput(f"{diagnosis} is no diagnosis; write one by estune explain --json")
    reasons = []
    for offer in values["remedies"]:
        if effect not in (None, offer["effect"]):
            continue
        if offer["tables"] and (offer["worth"] or effect) and not offer["refused"]:
            names = ("effect", "title", "harm", "tables")
            kept = {name: offer[name] for name in names}
            return Patch(**kept, predicted=offer["ratios"], gains=offer.get("gains") or {})
        reasons.append(f"{offer['effect'] or 'calibration'}: {offer['title']}; {_why_not(offer)}")
    told = "\n".join(reasons) or f"it has no remedy{' for ' + effect if effect else ''}"
    raise InvalidInput(f"{diagnosis} offers no remedy for the loop:\n{told}")


def _why_not(offer: Mapping[str, Any]) -> str:
    if offer["refused"]:
        return str(offer["refused"])
    if not offer["tables"]:
        return f"{offer['place']}: {offer['work']}"
    return "it is predicted to gain less than 2 %, or nothing could be predicted"


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _numbers(f"{name}.{key}", one)
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _numbers(name, one)
    elif isinstance(value, float):
        yield name, value


def _json(path: Path) -> Any:
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InvalidInput(f"{path} is no JSON: {error}") from error
