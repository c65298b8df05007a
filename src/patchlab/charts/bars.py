"""Bars of breaking points: for a method along an axis the last good and the first bad point, and what is said there.

In: an axis' values from easy to hard, and for each that was tried whether it is good, what was said of its bad trials,
and how many of them nothing was said about. Out: rows of a table, and a picture.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BAR_HEAD = ("method", "axis", "last good", "first bad", "said there", "silent", "trials a point")
ROW_IN = 0.26  # of a bar's row in a picture
_TITLE = "Blue: good, up to the value in it. Orange: up to the first bad value, to the right with what is said there."


class BarPoint(NamedTuple):
    """A point of an axis: codes of its bad trials with their counts, and the bad trials that nothing was said about."""

    good: bool
    said: Iterable[tuple[str, int]] = ()
    silent: int = 0


@dataclass(frozen=True)
class Bar:
    """A method along an axis: all values, and the points that were tried."""

    method: str
    axis: str
    values: Sequence[float]
    points: Sequence[BarPoint]
    n: int  # trials of each point

    @property
    def first_bad(self) -> int | None:
        """Index of the first bad point; None if all that were tried are good."""
        return next((i for i, point in enumerate(self.points) if not point.good), None)

    @property
    def last_good(self) -> int | None:
        """Index of the point before it; None if the first point is bad."""
        return ((len(self.points) if self.first_bad is None else self.first_bad) - 1) if self.first_bad != 0 else None

    @property
    def said(self) -> str:
        """What is said at the bad points, the two most frequent codes."""
        counts = Counter[str]()
        for point in self._bad:
            counts.update(dict(point.said))
        return ", ".join(code for code, _ in counts.most_common(1 if self.silent else 2))

    @property
    def silent(self) -> int:
        """Bad trials at the bad points that nothing was said about."""
        return sum(point.silent for point in self._bad)

    @property
    def _bad(self) -> Sequence[BarPoint]:
        return () if self.first_bad is None else self.points[self.first_bad :]

    @property
    def row(self) -> tuple[str, str, float | None, float | None, str, int, int]:
        """A table's row under `BAR_HEAD`."""
        last, first = (None if i is None else self.values[i] for i in (self.last_good, self.first_bad))
        return self.method, self.axis, last, first, self.said, self.silent, self.n


def said_text(said: Iterable[tuple[str, int]]) -> str:
    """Codes with their counts, as tables show them."""
    return ", ".join(f"{code} {count}" for code, count in said)


def draw_bars(bars: Sequence[Bar], figure: "Figure", title: str = "") -> None:
    """Draw a bar for each method and axis, one below the other, under a title of several lines."""
    axes = figure.add_subplot()
    for row, bar in enumerate(bars):
        last, first = bar.last_good, bar.first_bad
        good = 0.0 if last is None else last / (len(bar.values) - 1)
        end = 1.0 if first is None else first / (len(bar.values) - 1)
        axes.barh(row, 1.0, color="0.92", height=0.72)
        axes.barh(row, end - good, left=good, color="#e69f00", height=0.72)
        axes.barh(row, good, color="#0072b2", height=0.72)
        words = "holds" if first is None else f"{bar.values[first]:.3g}: {bar.said or 'nothing is said'}"
        words += f" ({bar.silent} silent)" if bar.silent and bar.said else ""
        axes.text(1.02, row, words, va="center", fontsize=9)
        if last is not None and good > 0.12:
            axes.text(good - 0.01, row, f"{bar.values[last]:.3g}", va="center", ha="right", fontsize=8.5, color="white")
    axes.set_yticks(range(len(bars)), [f"{bar.method}: {bar.axis}" for bar in bars], fontsize=9)
    axes.set(xlim=(0, 1.8), ylim=(len(bars) - 0.4, -0.6), xticks=[])
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.suptitle(title + _TITLE, fontsize=9.5, x=0.01, ha="left")
