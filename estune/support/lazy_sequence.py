"""A long sequence whose values are made when they are read, and are not kept."""

from array import array
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar, overload

T_co = TypeVar("T_co", covariant=True)
U = TypeVar("U")
K = TypeVar("K")


class LazySequence(Sequence[T_co]):
    """Values by their numbers; a slice is a list of them."""

    def __init__(self, numbers: Sequence[int], make: Callable[[int], T_co]) -> None:
        self._numbers, self._make = numbers, make

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, at: int) -> T_co: ...
    @overload
    def __getitem__(self, at: slice) -> list[T_co]: ...
    def __getitem__(self, at: int | slice) -> T_co | list[T_co]:
        if isinstance(at, slice):
            return [self._make(n) for n in self._numbers[at]]
        return self._make(self._numbers[at])

    def __iter__(self) -> Iterator[T_co]:
        return map(self._make, self._numbers)

    def where(self, condition: Callable[[T_co], object]) -> "LazySequence[T_co]":
        """Those of the values that fulfil a condition."""
        kept = (n for n in self._numbers if condition(self._make(n)))
        return LazySequence(array("q", kept), self._make)

    def groups(self, key: Callable[[T_co], K]) -> "dict[K, LazySequence[T_co]]":
        """The values by a key, in the order in which the keys first come."""
        numbers: dict[K, array[int]] = {}
        for n in self._numbers:
            numbers.setdefault(key(self._make(n)), array("q")).append(n)
        return {k: LazySequence(some, self._make) for k, some in numbers.items()}

    def map(self, function: Callable[[T_co], U]) -> "LazySequence[U]":
        """A function of each value."""
        make = self._make
        return LazySequence(self._numbers, lambda n: function(make(n)))
