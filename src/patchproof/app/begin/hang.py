"""Where a piece goes on an object that nobody has said anything of: `new`'s first guess.

In: a mesh and its length. Out: `Hang`, the largest piece that lies well in the middle of one of its sides.
Left out on purpose: other places than middles, which the search for a place knows better.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

from patchproof.app.begin.sides import SIDE_NAMES
from patchproof.base.strict import Refused, Side
from patchproof.mesh.mesh import Mesh
from patchproof.scene.bend import lay_for
from patchproof.scene.fitting import laid_well, largest
from patchproof.scene.placement import Frame, side_frame
from patchproof.sheets.piece import smallest_piece_mm

_SIDE_SHARE = 0.7  # of a side's extent that a piece covers at most
_LARGEST_MM = (165.0, 175.0)  # of a piece on A4, with the chart and the rulers around it
_LONGER = 1.6  # a piece's longer side over its shorter one at most
_FRONT = 1.25  # times as large has to be what is preferred to the front, or to a flat card
_TOP = 0.5  # of a top's size: who looks at it looks from above, as few photographs do
_ENOUGH = 0.8  # of the largest piece that any side is asked for: a flat card as large is not bent for more
_TRIED: tuple[Side, ...] = ("+z", "+x", "-x", "-z", "+y")


@dataclass(frozen=True)
class Hang:
    """Where the piece goes: a side's middle, or wherever the search finds; how large it is, and whether it bends."""

    side: Side | None
    size_mm: tuple[float, float]
    bend: bool

    @property
    def worth(self) -> float:
        """Its area, that of a flat card on the front counting more, and on the top less."""
        sides: dict[Side | None, float] = {"+z": _FRONT, "+y": _TOP}
        return prod(self.size_mm) * (1 if self.bend else _FRONT) * sides.get(self.side, 1)

    @property
    def words(self) -> str:
        """Where that is, for a sentence."""
        where = "wherever the search finds" if self.side is None else f"on its {SIDE_NAMES[self.side]} ({self.side})"
        return f"{'bent, ' if self.bend else ''}{where}"


def place_for(mesh: Mesh, length_mm: float) -> Hang:
    """The largest piece that lies well in the middle of a side; where none does, the least, to be searched for."""
    sides: dict[Side, tuple[float, float]] = {side: _wanted(side_frame(mesh, side)) for side in _TRIED}
    flat = [hang for side, size in sides.items() if (hang := _on_side(mesh, side, size, False))]
    if any(prod(hang.size_mm) >= _ENOUGH * max(map(prod, sides.values())) for hang in flat):
        return max(flat, key=lambda hang: hang.worth)  # bending takes seconds to try
    hangs = flat + [hang for side, size in sides.items() if (hang := _on_side(mesh, side, size, True))]
    if hangs:
        return max(hangs, key=lambda hang: hang.worth)
    least = smallest_piece_mm()
    if least > length_mm:
        do = "check --length-mm: markers of 8 mm need that much"
        raise Refused(f"an object with room for a piece of {least:g} mm", f"one of {length_mm:g} mm", do)
    return Hang(None, (least, least), False)


def _wanted(frame: Frame) -> tuple[float, float]:
    """The largest piece that a side is asked for."""
    width, height = (_SIDE_SHARE * extent for extent in frame.extent_mm)
    return min(width, _LONGER * height, _LARGEST_MM[0]), min(height, _LONGER * width, _LARGEST_MM[1])


def _on_side(mesh: Mesh, side: Side, size_mm: tuple[float, float], bend: bool) -> Hang | None:
    """The largest piece of that shape that lies well in the middle of a side."""
    frame, lay = side_frame(mesh, side), lay_for(bend)
    found = largest(size_mm, lambda trial: laid_well(mesh, frame, trial, 0.0, lay), smallest_piece_mm())
    return None if found is None else Hang(side, found, bend)
