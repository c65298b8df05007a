"""The goal of a patch, to raise the recognition rate or to lower it, and the answer to whether it does.

In: the word in a scene file or manifest; 95 % intervals of differences to controls. Out: `Goal`, whose sign tells
losses, verdicts, ledgers and reports what is better; none of them tests a goal's name. The answer is one of three, for
promises, evaluations and photographs alike:

    helps          the interval lies above 0
    does_not_help  it lies below `LEAST_GAIN`: a gain worth having is ruled out
    cannot_tell    it holds both

mirrored for `deceive`. The loss of each goal is in `optimizer.subject`.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal

GainWord = Literal["helps", "does_not_help", "cannot_tell"]
# The least gain worth having: one view in ten. Photographs hardly show less (150 of patch and control each: 16 points,
# by the demo's promise), and a full promise's differences have intervals of ± 5 to 10 points.
LEAST_GAIN = 0.10


class Goal(StrEnum):
    """Whether the patch is to raise the rate at which the target is recognized, or to lower it."""

    assist = "assist"
    deceive = "deceive"

    @property
    def sign(self) -> int:
        """The sign of a difference in rates that is a gain."""
        return 1 if self is Goal.assist else -1

    @property
    def words(self) -> dict[GainWord, str]:
        """The three answers in words, as sentences begin or headlines read."""
        verb = {1: "help", -1: "deceive"}[self.sign]
        return {"helps": f"{verb}s", "does_not_help": f"does not {verb}", "cannot_tell": "cannot be told yet"}

    def gains(self, interval: tuple[float, float]) -> tuple[float, float]:
        """The ends of a difference's interval as gains, the smaller first."""
        low, high = sorted(self.sign * end for end in interval)
        return low, high

    def answer(self, interval: tuple[float, float]) -> GainWord:
        """Say whether a patch helps whose rate minus a control's has this 95 % interval."""
        low, high = self.gains(interval)
        return "does_not_help" if high < LEAST_GAIN else "helps" if low > 0 else "cannot_tell"

    def hardest(self, differences: Mapping[str, tuple[float, float]]) -> str:
        """The control that decides: of those that rule a gain out, else of those that cannot tell, else of all, the one
        with the least gain in the middle of its interval.
        """

        def order(name: str) -> tuple[bool, bool, float]:
            word = self.answer(differences[name])
            return word != "does_not_help", word == "helps", sum(self.gains(differences[name]))

        return min(differences, key=order)


def points_text(rate: float, control_rate: float, interval: tuple[float, float]) -> str:
    """Return "+25.0 points [+14.8, +34.8]", the difference of two rates as they are printed, and its interval."""
    difference = round(100 * rate, 1) - round(100 * control_rate, 1)
    return "{:+.1f} points [{:+.1f}, {:+.1f}]".format(difference, *(100 * end for end in interval))
