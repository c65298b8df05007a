"""Rectangles (x, y, width, height) in millimeters, x right, y down: the only shape on a page."""

from __future__ import annotations

RectMm = tuple[float, float, float, float]
PointMm = tuple[float, float]
Srgb = tuple[float, float, float]
SwatchRect = tuple[RectMm, Srgb]


def rounded(rect: RectMm) -> RectMm:
    """To a nanometer, which keeps 0.1 + 0.2 out of the manifest."""
    x, y, w, h = rect
    return round(x, 6), round(y, 6), round(w, 6), round(h, 6)


def shift_rect(rect: RectMm, by: PointMm) -> RectMm:
    """The rectangle elsewhere."""
    return rounded((rect[0] + by[0], rect[1] + by[1], rect[2], rect[3]))


def grow_rect(rect: RectMm, by: float) -> RectMm:
    """The rectangle with that much more on each side."""
    return rect[0] - by, rect[1] - by, rect[2] + 2 * by, rect[3] + 2 * by


def rect_contains(outer: RectMm, inner: RectMm, slack: float = 0.0) -> bool:
    """Whether `inner` passes no edge of `outer` by more than `slack`."""
    return all(
        outer[i] <= inner[i] + slack and inner[i] + inner[i + 2] <= outer[i] + outer[i + 2] + slack for i in (0, 1)
    )


def rects_overlap(a: RectMm, b: RectMm, slack: float = 0.0) -> bool:
    """Whether two rectangles share more than `slack` along both axes."""
    return all(a[i] + slack < b[i] + b[i + 2] and b[i] + slack < a[i] + a[i + 2] for i in (0, 1))


def size_text(size_mm: tuple[float, ...]) -> str:
    """Width × height to a tenth of a millimeter."""
    return " × ".join(f"{round(side, 1):g}" for side in size_mm)
