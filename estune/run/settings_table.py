"""Tables of settings files made from declared settings."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, create_model

from estune.core.setting import Declared, declared, share
from estune.support.toml_file import TomlTable

_Table = TypeVar("_Table", bound=TomlTable)


def table_of(
    *kinds: type,
    leave_out: Collection[str] = (),
    own: bool = False,
    defaults: Mapping[str, Any] | None = None,
) -> Callable[[type[_Table]], type[_Table]]:
    """Adds the settings of dataclasses to a table as its keys.

    Args:
        leave_out: Settings that are no keys.
        own: Whether a key that is not given has the default of its declaration, or must be given
            without one; else it is None, and left to the rig.
        defaults: Defaults of this table, by key.
    """
    members = [m for kind in kinds for m in declared(kind) if m.name not in leave_out]

    def derive(table: type[_Table]) -> type[_Table]:
        fields: dict[str, Any] = {}
        for member in members:
            kind = _checked(member)
            if defaults and member.name in defaults:
                fields[member.name] = (kind, defaults[member.name])
            elif own and member.default is not None:
                fields[member.name] = (kind, ... if member.default is MISSING else member.default)
            else:
                fields[member.name] = (kind | None, None)
        return create_model(
            table.__name__,
            __base__=table,
            __module__=table.__module__,
            __doc__=table.__doc__,
            **fields,
        )

    return derive


def given_settings(table: TomlTable, kind: type) -> dict[str, Any]:
    """The settings of a dataclass that a table gives; none is None."""
    values = {member.name: getattr(table, member.name, None) for member in declared(kind)}
    return {
        name: None if value == "none" else value
        for name, value in values.items()
        if value is not None
    }


def _checked(member: Declared) -> Any:
    """Type of a key, with the range of its values."""
    setting, kind = member.setting, member.kind
    if kind in (float, int):
        kind = Annotated[
            kind, Field(gt=setting.above, ge=setting.least, lt=setting.below, le=setting.most)
        ]
        if setting.not_zero:
            kind = Annotated[kind, AfterValidator(_not_zero)]
    if setting.share:
        from_share = partial(_share, bare_most=setting.bare_most)
        kind = Annotated[kind, BeforeValidator(from_share)]
    return kind | Literal["none"] if setting.none else kind


def _share(value: Any, *, bare_most: float | None) -> Any:
    is_number = isinstance(value, int | float) or (isinstance(value, str) and value.endswith("%"))
    return share(value, bare_most) if is_number else value


def _not_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError("Input should not be zero")
    return value
