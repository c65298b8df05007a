"""What a patch is for: a goal, and which way a rate must go for it.

In: the word in a scene file or manifest. Out: `Goal`, with a sign by which losses, verdicts, ledgers and reports tell
better from worse: none of them asks for a goal by name. The loss of each stands in `optimizer.goals`.
"""

from __future__ import annotations

from enum import StrEnum


class Goal(StrEnum):
    """`sign` is +1 where recognizing the target is what is wanted, -1 where it is to be prevented."""

    sign: int
    assist = "assist", 1
    deceive = "deceive", -1

    def __new__(cls, word: str, sign: int):
        """A member that is its own word."""
        member = str.__new__(cls, word)
        member._value_, member.sign = word, sign
        return member
