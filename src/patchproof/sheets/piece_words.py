"""The texts on a cut piece: its top, its sheet's id and its name.

In: a sheet's content, and the piece's top-left corner. Out: texts and an arrow in the outer millimeter of the corner
markers' white, so that markers keep their module of white and the design its pixels. They may be lost in cutting, and
no measurement depends on them. Capitals of 0.7 mm are legible at reading distance; higher ones would reach into the
markers' quiet zones, and losing half of a quiet zone costs 0.1 mm of a measured corner.
"""

from patchproof.sheets.content import SheetContent
from patchproof.sheets.layout import CAP_HEIGHT, Box, Line, PageParts, text_width_mm
from patchproof.sheets.piece import SCISSORS_MM
from patchproof.sheets.rects import PointMm, RectMm
from patchproof.sheets.template import TextLine

SIZE_MM = 0.95  # font size
_CAPS_MM = SIZE_MM * CAP_HEIGHT
_INSET_MM = 0.4  # from the sides of the white: ten of the widest letters still fit beside an 8 mm marker
_ARROW_MM = 0.9  # width of the arrow and the space after it


def piece_words(content: SheetContent, corner: PointMm, holder: str = "piece") -> PageParts:
    """An arrow and "TOP" above the top-left marker, the sheet's id above the top-right one, and as much of the name as
    fits below the bottom-left one; `holder` is the name of the part of the page that contains them.
    """
    top_left, top_right, _, bottom_left = content.piece.reserved_mm[:4]
    lines, texts, boxes = [], [], []
    for rect, text in ((top_left, "TOP"), (top_right, content.sheet_id), (bottom_left, content.name.upper())):
        arrow_mm = _ARROW_MM if rect is top_left else 0
        text = _shorten(text, rect[2] - 2 * _INSET_MM - arrow_mm)
        left, top = corner[0] + rect[0] + _INSET_MM, corner[1] + _text_top(rect)
        if arrow_mm:
            lines += _arrow(left, top)
        start, width = left + arrow_mm, text_width_mm(text, SIZE_MM, True)
        texts.append(TextLine(at_mm=(start, top + _CAPS_MM), size_mm=SIZE_MM, text=text, bold=True, gray=0.2))
        boxes.append(Box(f'words "{text}" of {holder}', (left, top, start + width - left, _CAPS_MM), holder))
    return PageParts(tuple(lines), tuple(texts), tuple(boxes))


def _text_top(rect: RectMm) -> float:
    """The top of capitals in the middle of the outer millimeter of the white at the cut line."""
    inset = (SCISSORS_MM - _CAPS_MM) / 2
    return inset if rect[1] < SCISSORS_MM else rect[1] + rect[3] - inset - _CAPS_MM


def _arrow(left: float, top: float) -> list[Line]:
    """An arrow that points up, as high as capitals."""
    half = 0.25
    middle, tip = left + half, top + 0.05
    ends = ((middle, top + _CAPS_MM), (left, tip + half), (left + 2 * half, tip + half))
    return [Line((*end, middle, tip), 0.2) for end in ends]


def _shorten(text: str, width_mm: float) -> str:
    """As much of the text as fits into the width, with an ellipsis if it is cut."""
    if text_width_mm(text, SIZE_MM, True) <= width_mm:
        return text
    while text and text_width_mm(f"{text}…", SIZE_MM, True) > width_mm:
        text = text[:-1].rstrip()
    return f"{text}…" if text else ""
