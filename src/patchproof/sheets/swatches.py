"""The twelve swatches of a piece's frame: the corners of the RGB cube and four grays, between the markers.

In: where the markers are. Out: (rectangle in piece millimeters, sRGB) pairs, squares of one size, none larger than a
marker or nearer than a module to anything else. Where the twelve have no room at 4 mm each, fewer are laid out, the
most telling first; `write.check_sheet` then says so.
"""

from __future__ import annotations

import math

from patchproof.sheets.rects import RectMm, Srgb, SwatchRect

SMALLEST_SWATCH_MM = 4.0  # at the 1 px/mm of a distant photograph this leaves 2 × 2 clean pixels inside

# The last are given up first where there is no room: black and white can be read from markers and paper anyway.
# Dealt out to four sides in turn, each side gets one gray.
FRAME_COLORS: tuple[Srgb, ...] = (
    (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.6, 0.6),
    (0.2, 0.2, 0.2), (0.0, 1.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0, 0.0),
    (0.0, 0.0, 0.0), (0.4, 0.4, 0.4), (0.8, 0.8, 0.8), (1.0, 1.0, 1.0),
)  # fmt: skip


def frame_swatches(
    size_mm: tuple[float, float], edge_mm: float, marker_mm: float, module_mm: float, middle: tuple[bool, bool]
) -> tuple[SwatchRect, ...]:
    """As many of the twelve as fit at 4 mm or more, then as large as they fit, all one size, a module from all else.

    `edge_mm` is from cut line to markers; `middle` says whether horizontal and vertical sides have a mid-edge marker.
    """
    marker, module = marker_mm, module_mm
    gaps = _gaps(size_mm, edge_mm, marker, module, middle)
    for count in range(len(FRAME_COLORS), 0, -1):
        side = _largest_side([length for _, length, _ in gaps], count, module, marker)
        if side >= SMALLEST_SWATCH_MM:
            break
    else:
        return ()
    shares = _deal([_capacity(length, side, module) for _, length, _ in gaps], count)
    slots: list[list[RectMm]] = []
    for (start, length, along), share in zip(gaps, shares, strict=True):
        slots.append([])
        pitch = side + max((length - share * side) / (share + 1), module)
        first = (length - side - (share - 1) * pitch) / 2
        for i in range(share):
            offset = first + i * pitch
            corner = (start[0] + offset * along[0], start[1] + offset * along[1])
            inset = (marker - side) / 2  # in the middle of the markers' strip
            slots[-1].append((corner[0] + inset * along[1], corner[1] + inset * along[0], side, side))
    dealt = [rects[turn] for turn in range(max(shares)) for rects in slots if turn < len(rects)]
    return tuple(zip(dealt, FRAME_COLORS, strict=False))


def _gaps(size, edge, marker, module, middle) -> list[tuple[tuple[float, float], float, tuple[int, int]]]:
    """(start, length, direction) of the free runs between quiet zones, in an order in which the sides take turns.

    Each side gives its first run, clockwise, before any gives its second: few swatches still surround the design.
    """
    firsts, seconds = [], []
    # top, right, bottom, left: the axis it runs along, where it lies across, and whether clockwise is backwards
    far_x, far_y = size[0] - edge - marker, size[1] - edge - marker
    for axis, across, backwards in ((0, edge, False), (1, far_x, False), (0, far_y, True), (1, edge, True)):
        stops = [edge + marker + module, size[axis] - edge - marker - module]
        if middle[axis]:
            half = marker / 2 + module
            stops[1:1] = [size[axis] / 2 - half, size[axis] / 2 + half]
        runs = [
            ((start, across) if axis == 0 else (across, start), max(stop - start, 0.0), (1 - axis, axis))
            for start, stop in zip(stops[::2], stops[1::2], strict=True)
        ]
        first, *rest = reversed(runs) if backwards else runs
        firsts.append(first)
        seconds += rest
    return firsts + seconds


def _largest_side(lengths: list[float], count: int, gap: float, largest: float) -> float:
    """The largest square of which `count` fit into runs of those lengths, `gap` apart; 0 where none does."""
    sides = {min((length + gap) / k - gap, largest) for length in lengths for k in range(1, count + 1)}
    fitting = [side for side in sides if side > 0 and sum(_capacity(n, side, gap) for n in lengths) >= count]
    return max(fitting, default=0.0)


def _capacity(length: float, side: float, gap: float) -> int:
    return math.floor((length + gap) / (side + gap) + 1e-9)


def _deal(capacities: list[int], count: int) -> list[int]:
    """`count` dealt out one by one to places in turn, none beyond its capacity."""
    shares = [0] * len(capacities)
    while count > 0:
        for i, capacity in enumerate(capacities):
            if count > 0 and shares[i] < capacity:
                shares[i] += 1
                count -= 1
    return shares
