"""Rights of users at a rig."""

from estune.core.sentence_enum import SentenceEnum


class Right(SentenceEnum):
    """What a user may do. Each right includes those before it."""

    LOOK = "look", "descriptions, states, records and live samples"
    STOP = "stop", "the emergency stop, but not its reset"
    COMMAND = "command", "everything"

    def includes(self, other: "Right") -> bool:
        """Whether it includes another right."""
        order = list(Right)
        return order.index(self) >= order.index(other)
