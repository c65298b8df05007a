"""The typeface of the page: Bitstream Vera, which travels with reportlab and may be embedded.

Widths are needed to lay out a page, names to draw it; both come from here, so that they cannot differ.
"""

from __future__ import annotations

CAP_HEIGHT = 0.76  # of the size; Vera's ascenders and digits reach this high
DESCENT = 0.24  # of the size; below the baseline


def font_name(bold: bool) -> str:
    """The registered name of Vera or Vera Bold."""
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont

    name = "VeraBd" if bold else "Vera"
    if name not in pdfmetrics.getRegisteredFontNames():
        pdfmetrics.registerFont(TTFont(name, f"{name}.ttf"))
    return name


def text_width_mm(text: str, size_mm: float, bold: bool) -> float:
    """How far a line of text runs."""
    from reportlab.pdfbase import pdfmetrics

    return pdfmetrics.stringWidth(text, font_name(bold), size_mm)
