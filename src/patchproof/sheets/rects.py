"""Operations on rectangles (x, y, width, height) in millimeters, x right, y down: the only shape on a page."""

RectMm = tuple[float, float, float, float]
PointMm = tuple[float, float]
Srgb = tuple[float, float, float]
SwatchRect = tuple[RectMm, Srgb]


def round_rect(rect: RectMm) -> RectMm:
    """Round to a nanometer, so that the manifest does not hold 0.30000000000000004."""
    x, y, w, h = rect
    return round(x, 6), round(y, 6), round(w, 6), round(h, 6)


def shift_rect(rect: RectMm, shift_mm: PointMm) -> RectMm:
    """Shift a rectangle, and round it."""
    return round_rect((rect[0] + shift_mm[0], rect[1] + shift_mm[1], rect[2], rect[3]))


def grow_rect(rect: RectMm, by_mm: float) -> RectMm:
    """Extend a rectangle on each of its four sides; a negative length shrinks it."""
    return rect[0] - by_mm, rect[1] - by_mm, rect[2] + 2 * by_mm, rect[3] + 2 * by_mm


def rect_contains(outer: RectMm, inner: RectMm, slack: float = 0.0) -> bool:
    """True if `inner` exceeds no edge of `outer` by more than `slack`."""
    return all(
        outer[i] <= inner[i] + slack and inner[i] + inner[i + 2] <= outer[i] + outer[i + 2] + slack for i in (0, 1)
    )


def rects_overlap(a: RectMm, b: RectMm, slack: float = 0.0) -> bool:
    """True if two rectangles overlap by more than `slack` along both axes."""
    return all(a[i] + slack < b[i] + b[i + 2] and b[i] + slack < a[i] + a[i + 2] for i in (0, 1))


def size_text(size_mm: tuple[float, ...]) -> str:
    """Format width × height, to a tenth of a millimeter."""
    return " × ".join(f"{round(side, 1):g}" for side in size_mm)
