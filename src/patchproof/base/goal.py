"""The goal of a patch: to raise the recognition rate, or to lower it.

In: the word in a scene file or manifest. Out: `Goal`, whose sign tells losses, verdicts, ledgers and reports what is
better; none of them tests a goal's name. The loss of each goal is in `optimizer.goals`.
"""

from enum import StrEnum


class Goal(StrEnum):
    """The goal; `sign` is +1 if the target is to be recognized, -1 if that is to be prevented."""

    sign: int
    assist = "assist", 1
    deceive = "deceive", -1

    def __new__(cls, word: str, sign: int):
        """Make a member that equals its word."""
        member = str.__new__(cls, word)
        member._value_, member.sign = word, sign
        return member
