"""The form that starts a tuning: its settings in words, their check, and what to expect."""

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple, TypeVar

from estune.core.setting import Bounds, Declared
from estune.errors import InvalidInput
from estune.run.planning import make_plan, suited_step
from estune.run.toml_tables import (
    COST,
    LIMITS,
    SEARCH,
    STEP,
    CostTable,
    SearchTable,
    SettingsGroup,
    StepTable,
)
from estune.support.toml_file import TomlTable, validate
from estune.trial import RigDescription
from estune.tuners import DEFAULT_TUNER
from estune.web.banner import duration
from estune.web.listed_run import ListedRun

OPEN = ("max_sensitivity", "max_overshoot")
"""Settings that are shown at once; all others stand under "more"."""
MORE: tuple[tuple[str, SettingsGroup], ...] = (
    ("Search", SEARCH),
    ("Limits", LIMITS),
    ("Step trial", STEP),
    ("Cost of a trial", COST),
)
WORDS = {
    "max_sensitivity": "robustness: largest Ms",
    "max_overshoot": "largest overshoot",
    "min_phase_margin_deg": "smallest phase margin",
    "trials": "search at most this many trials",
    "repeats": "repeat the old and new gains at least",
    "tolerance": "end when less than this is left to gain",
    "precision": "repeat until the gain is known to",
    "eta_max": "stop a trial above this cost",
    "preload_N": "setpoint before the step",
    "step_N": "size of the step",
    "step_at_s": "time of the step",
    "duration_s": "length of a trial",
    "ramp_s": "ramp to the new setpoint over",
    "load_N": "size of a load step",
    "load_at_s": "time of the load step",
    "preset": "kind of cost",
    "settling_time_s": "desired settling time",
    "weight": "weight over the transient",
    "time_unit": "unit of time in the cost",
    "move_weight": "price of moves of the command",
    "effort_weight": "price of the command",
    "rejection": "share of load rejection",
}
"""What a setting is called in the form."""
OPTIONS = {"preset": "--cost"}
"""Settings whose option is not their name."""
USUAL = 5, 10
"""Trials of a tuning with the default settings: 5 to 9 in 19 tunings, of the reference reel at
three lengths with five seeds, and of four linear plants."""
_Table = TypeVar("_Table", bound=TomlTable)


class FormFault(InvalidInput):
    """Settings that cannot be used."""

    def __init__(self, fields: Mapping[str, str]) -> None:
        super().__init__("; ".join(f"{WORDS.get(n, n)}: {why}" for n, why in fields.items()))
        self.fields = dict(fields)


def form(rig: Mapping[str, Any] | None, earlier: Sequence[ListedRun]) -> dict[str, Any]:
    """The form as JSON values."""
    groups = [(title, _members(group)) for title, group in MORE]
    shown = [m for _, members in groups for m in members if m.name in OPEN]
    return {
        "open": [_field(m, rig) for m in sorted(shown, key=lambda m: OPEN.index(m.name))],
        "more": [
            {"title": title, "settings": [_field(m, rig) for m in members if m.name not in OPEN]}
            for title, members in groups
        ],
        "expected": expected(rig, earlier),
    }


def _members(group: SettingsGroup) -> list[Declared]:
    return [member for member in group.members if member.name != "bounds"]


def _field(member: Declared, rig: Mapping[str, Any] | None) -> dict[str, Any]:
    unit = "%" if member.setting.share else member.setting.unit
    if unit == "N":  # stands for the unit of the measurement or of the command
        signal = "command" if member.name == "load_N" else "measurement"
        unit = rig[signal].rpartition(", ")[2] if rig and ", " in rig[signal] else ""
    otherwise = member.default_text
    if member.setting.share and isinstance(member.default, float):
        otherwise = f"{100.0 * member.default:g}"
    return {
        "name": member.name,
        "label": ", ".join(filter(None, (WORDS[member.name], unit))),
        "choices": list(member.choices),
        "is_number": member.kind is not str,
        "help": member.setting.help,
        "otherwise": otherwise,
        "is_open": member.name in OPEN,
    }


def expected(rig: Mapping[str, Any] | None, earlier: Sequence[ListedRun]) -> str:
    """How many trials a tuning takes, and how long."""
    rows = [(run, run.row()) for run in earlier]
    known = [(run, row) for run, row in rows if row.get("state") == "finished" and row["trials"]]
    if known:
        counts = sorted(row["trials"] for _, row in known)
        took_s = median(run.took_s for run, _ in known)
        many = str(counts[0]) if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
        of = f"The last {len(known)} tunings" if len(known) > 1 else "The last tuning"
        return f"{of} of this rig took {many} trials, in about {duration(took_s)}."
    text = f"A tuning usually takes {USUAL[0]} to {USUAL[1]} trials"
    if rig is None:
        return f"{text}."
    trial_s = rig["duration_s"]
    low, high = (duration(count * trial_s) for count in USUAL)
    low = low.removesuffix(f" {high.rpartition(' ')[2]}")
    return f"{text}; one takes {duration(trial_s)} here, so {low} to {high} in real time."


class TuningSettings(NamedTuple):
    """Settings of the form that are given, checked one by one."""

    options: tuple[str, ...]
    search: SearchTable
    step: StepTable
    cost: CostTable

    def check(self, rig: RigDescription) -> None:
        """Refuses settings that do not fit a rig, before anything moves.

        Raises:
            InvalidInput: the rig would refuse the trial, or the settings contradict each other.
        """
        cost = self.cost.of(rig)
        step = suited_step(self.step.of(rig), cost, rig)
        search = {**self.search.search, "start": None, "tuner": DEFAULT_TUNER}
        rig.limits.check(make_plan(rig, "page", step=step, cost=cost, **search).step)


def read_settings(settings: Mapping[str, Any]) -> TuningSettings:
    """The settings that somebody has filled in, as texts; empty ones are not given.

    Raises:
        FormFault: some cannot be used.
        InvalidInput: there is no such setting.
    """
    members = {m.name: m for _, group in MORE for m in _members(group)}
    given = {name: str(value).strip() for name, value in settings.items() if str(value).strip()}
    if unknown := given.keys() - members:
        known = ", ".join(members)
        raise InvalidInput(f"there is no setting {min(unknown)!r}; one of: {known}")
    faults: dict[str, str] = {}
    values: dict[str, Any] = {}
    for name, text in given.items():
        try:
            values[name] = _value(members[name], text)
        except ValueError as error:
            faults[name] = str(error)
    search = _table(SearchTable, values, faults)
    step, cost = _table(StepTable, values, faults), _table(CostTable, values, faults)
    if faults or search is None or step is None or cost is None:
        raise FormFault(faults)
    return TuningSettings(tuple(_options(values)), search, step, cost)


def _value(member: Declared, text: str) -> Any:
    """The value that a text of the form stands for; a share is in per cent.

    Raises:
        ValueError: it is none; the message says what to write.
    """
    setting = member.setting
    if (text == "none" and setting.none) or member.choices or member.kind is str:
        return text
    bounds: Bounds = setting
    kind = int if member.kind is int else float
    if setting.share:
        names = ("above", "least", "below", "most")
        ends = {name: getattr(bounds, name) for name in names}
        bounds = Bounds(**{name: end and 100.0 * end for name, end in ends.items()})
        text = text.removesuffix("%")
    if "." not in text and text.count(",") == 1:  # a decimal comma
        text = text.replace(",", ".")
    what = ", ".join(filter(None, ("a whole number" if kind is int else "a number", bounds.text)))
    try:
        value = kind(text)
    except ValueError:
        raise ValueError(f"write {what} instead of {text!r}") from None
    if not bounds.hold(value):
        raise ValueError(f"write {what}")
    return f"{value:g}%" if setting.share else value


def _table(kind: type[_Table], values: Mapping[str, Any], faults: dict[str, str]) -> _Table | None:
    """A table of the values that belong to it; what is wrong is added to the faults."""
    own = {name: value for name, value in values.items() if name in kind.model_fields}
    try:
        return validate(kind, own, "form")
    except InvalidInput as error:
        for line in str(error).split("\n"):
            _, name, *why = line.split(": ", 2)
            faults.setdefault(name, ": ".join(why))
    return None


def _options(values: Mapping[str, Any]) -> Iterator[str]:
    for name, value in values.items():
        option = OPTIONS.get(name, f"--{name.replace('_', '-')}")
        yield f"{option}={value}"
