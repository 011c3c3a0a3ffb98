"""Tables of state machines: for each event in each mode a function, or the reason for none.

All state machines of estune have this form. The functions differ in what they take and return,
which each machine says; the first line of their docstring is the text of the printed table.
"""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from types import MappingProxyType
from typing import Any, Generic, TypeVar

E = TypeVar("E")
M = TypeVar("M", bound=Enum)
F = TypeVar("F", bound=Callable[..., Any])
_AnyF = TypeVar("_AnyF", bound=Callable[..., Any])

IMPOSSIBLE = "impossible"
"""Reason where an event cannot occur in a mode unless a program is wrong."""


class StateTable(Generic[E, M, F]):
    """What each event does in each mode.

    Attributes:
        modes: The modes: its columns, in this order.
        rows: Function, or the reason why there is none, by event and mode.
    """

    __slots__ = ("modes", "rows")

    def __init__(self, modes: type[M], rows: Mapping[E, "TableRow[M, F]"]) -> None:
        self.modes: Sequence[M] = tuple(modes)
        self.rows: Mapping[E, Mapping[M, F | str]] = MappingProxyType(
            {event: row.cells(self.modes) for event, row in rows.items()}
        )

    def cell(self, event: E, mode: M) -> F | str:
        """The function of an event in a mode, or the reason why there is none."""
        return self.rows[event][mode]


class TableRow(Generic[M, F]):
    """What one event does: the usual cell, and those of other modes."""

    __slots__ = ("_others", "_usual")

    def __init__(self, usual: F | str, *others: tuple[F | str, tuple[M, ...]]) -> None:
        self._usual, self._others = usual, others

    def cells(self, modes: Sequence[M]) -> Mapping[M, F | str]:
        """The cell of each mode."""
        made: dict[M, F | str] = dict.fromkeys(modes, self._usual)
        for cell, where in self._others:
            made |= dict.fromkeys(where, cell)
        return MappingProxyType(made)


def described(sentence: str) -> Callable[[_AnyF], _AnyF]:
    """Gives a function that is made, not written, its sentence."""

    def decorate(function: _AnyF) -> _AnyF:
        function.__doc__ = sentence
        return function

    return decorate
