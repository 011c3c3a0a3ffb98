"""Settings: fields of a dataclass with what people and programs must know of them.

A setting is declared once, in the dataclass that uses its value:

    step_N: Annotated[float, Setting("Size of the step", "N", not_zero=True)]

Made from this declaration are the attributes in the docstring (`documented`), the check of its
range (`check_settings`), the keys of settings files (`estune.run.settings_table`), the options of
the command line (`estune.cli.options`), the parameters of functions (`keywords`), the tables of
docs/reference/settings.md, and `to_json` for forms.
"""

import difflib
import inspect
import math
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, MISSING, dataclass, fields, is_dataclass
from functools import wraps
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Concatenate,
    Literal,
    NamedTuple,
    ParamSpec,
    SupportsFloat,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from estune.errors import InvalidInput

_T = TypeVar("_T")
_R = TypeVar("_R")
_P = ParamSpec("_P")
_LINE = 92


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """Range of a number; None is no bound.

    Attributes:
        above: Bound that the value must exceed.
        below: Bound that the value must stay below.
        infinite: Whether an infinite value is accepted.
    """

    above: float | None = None
    least: float | None = None
    below: float | None = None
    most: float | None = None
    not_zero: bool = False
    infinite: bool = False

    @property
    def text(self) -> str:
        """The range in words; empty where any finite number will do."""
        low = [f"above {self.above:g}"] if self.above is not None else []
        low += [f"{self.least:g} or more"] if self.least is not None else []
        high = [f"below {self.below:g}"] if self.below is not None else []
        high += [f"at most {self.most:g}"] if self.most is not None else []
        if self.least is not None and high:
            return f"from {self.least:g} to {high[0].removeprefix('at most ')}"
        return ", ".join([*low, *high, *(["not zero"] if self.not_zero else [])])

    def hold(self, value: float) -> bool:
        """Whether a value is finite and in the range."""
        return (
            (math.isfinite(value) or (self.infinite and not math.isnan(value)))
            and (self.above is None or value > self.above)
            and (self.least is None or value >= self.least)
            and (self.below is None or value < self.below)
            and (self.most is None or value <= self.most)
            and not (self.not_zero and value == 0.0)
        )


@dataclass(frozen=True, slots=True)
class Setting(Bounds):
    """Meaning, unit and range of a field, for `Annotated`.

    Attributes:
        help: What it is, in a phrase or more, without its unit and range.
        unit: Its unit; empty without one.
        otherwise: What holds where it is not given, if that is not the default of the field.
        younger: Whether it is younger than messages and files that must stay as they are: where
            it has its default, it is left out of digests and keys.
        share: Whether it is a share, which may be written in per cent.
        none: What the word "none" means where it may be written; empty where it may not.
        bare_most: Largest share that may be written without a per cent sign; None is any.
    """

    help: str
    unit: str = ""
    _: KW_ONLY
    otherwise: str = ""
    younger: bool = False
    share: bool = False
    none: str = ""
    bare_most: float | None = None


class Declared(NamedTuple):
    """A declared field.

    Attributes:
        name: Name of the field, and key in files and messages.
        kind: Its type without None: float, int, bool, str, a Literal, or another.
        default: Its default; `MISSING` where it must be given.
    """

    name: str
    kind: Any
    default: Any
    setting: Setting

    @property
    def choices(self) -> tuple[str, ...]:
        """The values of a choice; empty for others."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def meaning(self) -> str:
        """Help, unit and range in one phrase."""
        first, semicolon, rest = self.setting.help.partition(";")
        unit = self.setting.unit and f", {self.setting.unit}"
        text = f"{first}{unit}{semicolon}{rest}"
        return "; ".join(filter(None, (text, self.setting.text)))

    @property
    def full_meaning(self) -> str:
        """The meaning, and what holds where the field is not given, but for a plain default."""
        default = self.setting.otherwise and f"by default {self.setting.otherwise}"
        return "; ".join(filter(None, (self.meaning, default)))

    @property
    def default_text(self) -> str:
        """What holds where it is not given, in words; empty where nothing does."""
        if self.setting.otherwise:
            return self.setting.otherwise
        if self.default is None and self.setting.none:
            return "none"
        if self.default in (MISSING, None, ""):
            return ""
        if self.setting.share:
            return f"{self.default:.4g}, {100.0 * self.default:.4g} %"
        if isinstance(self.default, float):
            return f"{self.default:.4g}"
        return str(self.default)

    def fault(self, value: Any) -> str:
        """Why the field cannot have a value; empty where it can."""
        if value is None:
            return ""
        unit = self.setting.unit and f" {self.setting.unit}"
        if self.choices:
            listed = ", ".join(map(repr, self.choices[:-1])) + f" or {self.choices[-1]!r}"
            return (
                "" if value in self.choices else f"{self.name} is {value!r}; it must be {listed}"
            )
        if self.kind not in (float, int):
            return ""
        if not isinstance(value, SupportsFloat):
            return f"{self.name} is {value!r}; it must be a number{unit and ' of'}{unit}"
        if self.setting.hold(float(value)):
            return ""
        kind = "a number" if self.setting.infinite else "finite"
        must = " and ".join(filter(None, (kind, self.setting.text)))
        return f"{self.name} is {value}{unit}; it must be {must}"

    def to_json(self) -> dict[str, Any]:
        """The declaration as JSON values, for a form."""
        setting = self.setting
        ranged = {name: getattr(setting, name) for name in ("above", "least", "below", "most")}
        return {
            "name": self.name,
            "type": "choice" if self.choices else getattr(self.kind, "__name__", "text"),
            "choices": list(self.choices),
            "unit": setting.unit,
            "help": setting.help,
            "default": None if self.default is MISSING else self.default,
            "otherwise": self.default_text,
            "share": setting.share,
            "none": setting.none,
            "not_zero": setting.not_zero,
            **ranged,
        }


_DECLARED: dict[type, tuple[Declared, ...]] = {}


def declared(kind: type) -> tuple[Declared, ...]:
    """The declared fields of a dataclass, in their order."""
    if kind not in _DECLARED:
        _DECLARED[kind] = tuple(_find(kind))
    return _DECLARED[kind]


def _find(kind: Any) -> Iterator[Declared]:
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        extras = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        setting = next((extra for extra in extras if isinstance(extra, Setting)), None)
        if setting is not None:
            bare = _without_none(get_args(hint)[0])
            yield Declared(field.name, bare, field.default, setting)


def stated(value: Any) -> dict[str, Any]:
    """The fields of a dataclass by name, but for younger ones that have their default."""
    younger = {m.name: m.default for m in declared(type(value)) if m.setting.younger}
    named = ((field.name, getattr(value, field.name)) for field in fields(value))
    return {name: v for name, v in named if name not in younger or v != younger[name]}


def check_settings(value: Any) -> None:
    """Refuses a value of a dataclass whose declared fields are out of their ranges.

    Raises:
        InvalidInput: one of them is.
    """
    for field in declared(type(value)):
        if fault := field.fault(getattr(value, field.name)):
            raise InvalidInput(fault)


def documented(kind: type[_T]) -> type[_T]:
    """Adds the declared fields of a dataclass to its docstring, as its attributes."""
    meanings = {member.name: member.meaning for member in declared(kind)}
    kind.__doc__ = _with_section(kind.__doc__ or "", "Attributes", meanings)
    return kind


def keywords(
    options: Callable[_P, _T],
) -> Callable[[Callable[[Any, _T], _R]], Callable[Concatenate[Any, _P], _R]]:
    """Gives a function the fields of a dataclass as keyword arguments, in place of its value.

    The signature and the docstring of the function have them one by one, as if they were written
    there; type checkers see them, too.

    Raises:
        TypeError: (of the function) an argument is missing or unknown.
    """

    def decorate(function: Callable[[Any, _T], _R]) -> Callable[Concatenate[Any, _P], _R]:
        first, _ = inspect.signature(function).parameters.values()
        own = inspect.signature(options).parameters.values()
        signature = inspect.Signature(
            [first, *(p.replace(annotation=_bare(p.annotation)) for p in own)],
            return_annotation=inspect.signature(function).return_annotation,
        )

        @wraps(function)
        def called(*args: Any, **kwargs: Any) -> _R:
            unknown = kwargs.keys() - signature.parameters.keys()
            if unknown:
                raise TypeError(_unknown_keyword(function.__name__, min(unknown), options))
            given = signature.bind(*args, **kwargs)  # its errors name the function's arguments
            target: Any = given.arguments.pop(first.name)
            made: Any = options
            return function(target, made(**given.kwargs))

        kind: Any = options
        meanings = {member.name: member.full_meaning for member in declared(kind)}
        called.__doc__ = _with_section(function.__doc__ or "", "Args", meanings)
        called.__annotations__ = {p.name: p.annotation for p in signature.parameters.values()}
        made: Any = called
        made.__signature__ = signature
        return cast("Callable[Concatenate[Any, _P], _R]", made)

    return decorate


def _unknown_keyword(function: str, name: str, options: Any) -> str:
    """What to write instead: an argument that has a setting of this name, or the nearest one."""
    said = f"{function}() got an unexpected keyword argument {name!r}"
    hints = get_type_hints(options)
    for argument, hint in hints.items():
        for kind in (hint, *get_args(hint)):
            is_setting = isinstance(kind, type) and is_dataclass(kind)
            if is_setting and name in {field.name for field in fields(kind)}:
                return f"{said}; give {argument}={kind.__name__}({name}=...)"
    near = difflib.get_close_matches(name, hints, 1)
    return f"{said}; did you mean {near[0]}?" if near else said


def share(value: float | str, bare_most: float | None = None) -> float:
    """A share, given as a number or as text in per cent.

    Args:
        value: The number or text.
        bare_most: Largest number that is taken without a per cent sign.

    Raises:
        ValueError: it is neither, or a number that is likely to be meant in per cent.
    """
    if isinstance(value, str) and value.strip().endswith("%"):
        return 0.01 * float(value.strip().removesuffix("%"))
    number = float(value)
    if bare_most is not None and number > bare_most:
        raise ValueError(
            f'{number:g} is {number:.0%}; did you mean {number:g}%? Write "{number:g}%", or '
            f'"{100.0 * number:g}%"'
        )
    return number


def _with_section(doc: str, title: str, meanings: Mapping[str, str]) -> str:
    """A docstring with members of a section added to it, after those there are."""
    lines = []
    for name, meaning in meanings.items():
        text = f"{name}: {meaning}."
        lines += textwrap.wrap(text, _LINE, initial_indent=" " * 4, subsequent_indent=" " * 8)
    made = "\n".join(lines)
    head, found, rest = inspect.cleandoc(doc).partition(f"\n\n{title}:\n")
    if found:
        listed, gap, rest = rest.partition("\n\n")
        return f"{head}{found}{listed}\n{made}{gap}{rest}"
    head, raises, rest = head.partition("\n\nRaises:\n")
    return f"{head}\n\n{title}:\n{made}{raises}{rest}\n"


def _bare(hint: Any) -> Any:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _without_none(hint: Any) -> Any:
    if get_origin(hint) not in (Union, UnionType):
        return hint
    left = tuple(part for part in get_args(hint) if part is not NoneType)
    return left[0] if len(left) == 1 else Union[left]  # noqa: UP007  of a tuple
