"""What a piece that has been cut out says of itself: which way is up, of which sheet it is, and what it shows.

In: a piece with what belongs to it, and where its top-left corner lies. Out: words and an arrow in the outer millimeter
of its corner markers' white, which nothing else needs: markers keep their module of white, the design all its pixels.
Words may be cut off with it, and so nothing that is measured depends on them. Capitals of 0.7 mm are legible at reading
distance; higher ones would reach into the markers' white, half of which is worth 0.1 mm of a measured corner.
"""

from __future__ import annotations

from patchproof.sheets.content import SheetContent
from patchproof.sheets.layout import CAP_HEIGHT, Box, Line, Parts, text_width_mm
from patchproof.sheets.piece import SCISSORS_MM
from patchproof.sheets.rects import PointMm, RectMm
from patchproof.sheets.template import TextLine

SIZE_MM = 0.95  # of the letters
_CAPS_MM = SIZE_MM * CAP_HEIGHT
_ASIDE_MM = 0.4  # from the sides of the white: between 8 mm markers' ten of the widest letters still fit
_ARROW_MM = 0.9  # with the space behind it


def piece_words(content: SheetContent, corner: PointMm, holder: str = "piece") -> Parts:
    """An arrow and "TOP" over the top-left marker, the sheet's id over the top-right one, and under the bottom-left one
    as much of the name as fits; `holder` is the part of the page that they lie in.
    """
    top_left, top_right, _, bottom_left = content.piece.reserved_mm[:4]
    lines, texts, boxes = [], [], []
    for rect, text, arrow in (
        (top_left, "TOP", True),
        (top_right, content.sheet_id, False),
        (bottom_left, content.name.upper(), False),
    ):
        room = rect[2] - 2 * _ASIDE_MM - (_ARROW_MM if arrow else 0)
        text = _fitting(text, room)
        left, top = corner[0] + rect[0] + _ASIDE_MM, corner[1] + _top_of(rect)
        if arrow:
            lines += _arrow(left, top)
        start, width = left + (_ARROW_MM if arrow else 0), text_width_mm(text, SIZE_MM, True)
        texts.append(TextLine(at_mm=(start, top + _CAPS_MM), size_mm=SIZE_MM, text=text, bold=True, gray=0.2))
        boxes.append(Box(f'words "{text}" of {holder}', (left, top, start + width - left, _CAPS_MM), holder))
    return Parts(tuple(lines), tuple(texts), tuple(boxes))


def _top_of(rect: RectMm) -> float:
    """Where capitals begin in the white at the cut line: in the middle of its outer millimeter."""
    inset = (SCISSORS_MM - _CAPS_MM) / 2
    return inset if rect[1] < SCISSORS_MM else rect[1] + rect[3] - inset - _CAPS_MM


def _arrow(left: float, top: float) -> list[Line]:
    """An arrow that points up, as high as capitals."""
    half = 0.25
    middle, tip = left + half, top + 0.05
    ends = ((middle, top + _CAPS_MM), (left, tip + half), (left + 2 * half, tip + half))
    return [Line((*end, middle, tip), 0.2) for end in ends]


def _fitting(text: str, width_mm: float) -> str:
    """As much of the text as goes into the width."""
    if text_width_mm(text, SIZE_MM, True) <= width_mm:
        return text
    while text and text_width_mm(f"{text}…", SIZE_MM, True) > width_mm:
        text = text[:-1].rstrip()
    return f"{text}…" if text else ""
