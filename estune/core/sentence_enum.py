"""Words of a vocabulary, each with the sentence that explains it."""

from enum import StrEnum
from typing import Self


class SentenceEnum(StrEnum):
    """A string enumeration whose members are written `NAME = "value", "sentence"`.

    Attributes:
        sentence: The meaning of a member.
    """

    sentence: str

    def __new__(cls, value: str, sentence: str = "") -> Self:
        """A member by its value, which alone is stored and sent."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.sentence = sentence
        return member
