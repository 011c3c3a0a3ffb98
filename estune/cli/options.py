"""Options of the command line made from declared settings."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any, ClassVar, TypeVar

from cyclopts import Group, Parameter
from cyclopts.completion import CompletionContext

from estune.cli.values import share_from
from estune.core.setting import Declared
from estune.loop_model.optimum import RobustnessLimits
from estune.run.toml_tables import COST, LIMITS, SEARCH, STEP, SettingsGroup
from estune.tuners import TUNERS, tuner_class


def _check_tuner(_kind: Any, name: str) -> None:
    tuner_class(name)


def _tuner_names(_context: CompletionContext) -> Iterable[tuple[str, str]]:
    return [(name, tuner.purpose) for name, tuner in TUNERS.items()]


TunerName = Annotated[
    str,
    Parameter(
        validator=_check_tuner,
        completer=_tuner_names,
        help=f"Tuner: {', '.join(TUNERS)}, or module:Class of your own tuner.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of one group, each None where it is not given.

    Attributes:
        written: The numbers that are written as text, in per cent or "none": by name the largest
            that may be written without a per cent sign, None for any.
    """

    written: ClassVar[Mapping[str, float | None]] = {}

    @property
    def given(self) -> dict[str, Any]:
        """The options that are given, as settings files have them.

        Raises:
            InvalidInput: a share or a number cannot be read.
        """
        values = {name: value for name, value in vars(self).items() if value is not None}
        return {
            name: share_from(_option(name), value, self.written[name])
            if name in self.written and value != "none"
            else value
            for name, value in values.items()
        }


_Options = TypeVar("_Options", bound=Options)


def options_of(
    group: SettingsGroup, place: int, names: Mapping[str, str] | None = None
) -> Callable[[type[_Options]], type[_Options]]:
    """Adds the settings of a group as options.

    Args:
        group: The group.
        place: Its place in the help.
        names: Options that have another name than their key; an empty one is left out.
    """
    options = {member: _option(member.name) for member in group.members}
    options |= {m: (names or {}).get(m.name, option) for m, option in options.items()}

    def derive(kind: type[_Options]) -> type[_Options]:
        fields = [
            (member.name, _annotated(member, option), field(default=None))
            for member, option in options.items()
            if option
        ]
        made: Any = make_dataclass(kind.__name__, fields, bases=(kind,), frozen=True, kw_only=True)
        made.__doc__, made.__module__ = kind.__doc__, kind.__module__
        made.written = {m.name: m.setting.bare_most for m in group.members if _is_written(m)}
        heading = Group(group.title, sort_key=place)
        derived: type[_Options] = Parameter(name="*", group=heading)(made)
        return derived

    return derive


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _is_written(member: Declared) -> bool:
    return member.setting.share or bool(member.setting.none)


def _annotated(member: Declared, option: str) -> Any:
    """Type of an option with its help."""
    setting = member.setting
    forms = [*(["as 5% or 0.05"] if setting.share else []), *(["or none"] if setting.none else [])]
    default = member.default_text and f" Default: {member.default_text}."
    text = f"{', '.join([member.meaning, *forms])}.{default}"
    kind = str if _is_written(member) else member.kind
    return Annotated[kind | None, Parameter(name=option, help=text, show_default=False)]


@options_of(SEARCH, 0, {"bounds": ""})
class SearchOptions(Options):
    """The search for gains."""


@options_of(STEP, 1)
class StepOptions(Options):
    """The step trial; defaults are suggested by the rig."""


@options_of(COST, 2, {"preset": "--cost"})
class CostOptions(Options):
    """The cost of a trial; defaults apply where omitted."""


@options_of(LIMITS, 3)
class LimitOptions(Options):
    """Limits by which the tuned gains are judged, and which model_based keeps."""

    @property
    def limits(self) -> RobustnessLimits | None:
        """The limits; None where none is given."""
        given = {name: None if v == "none" else v for name, v in self.given.items()}
        return RobustnessLimits(**given) if given else None


NO_SEARCH, NO_STEP, NO_COST, NO_LIMITS = (
    SearchOptions(),
    StepOptions(),
    CostOptions(),
    LimitOptions(),
)
