"""The plan, a sheet's last page: the place of the piece on the object, and how to photograph it.

In: a `PlanPage`: a picture of the object with its millimeters, the piece's outline on it, and paragraphs. Out: the
page. Dimension chains above and beside the picture run from edge to edge of the object's side. The picture is passed
in; this module draws on paper only.
"""

from dataclasses import dataclass

import numpy as np

from patchproof.base.errors import Refused
from patchproof.sheets.layout import CAP_HEIGHT, DESCENT, Box, Line, PageLayout, check_layout, text_box, text_width_mm
from patchproof.sheets.pdf import PdfPage
from patchproof.sheets.rects import PointMm, RectMm
from patchproof.sheets.template import Template, TextLine

PICTURE_SHARE = 0.42  # of the page's height at most
ABOVE_MM, BESIDE_MM = 13.0, 22.0  # space for the dimension chains
HEADING_MM, TEXT_MM, LEADING = 3.2, 2.6, 1.45


@dataclass(frozen=True)
class PlacementPicture:
    """A picture of the piece on the object, seen straight from its side; millimeters, x right, y down."""

    picture: np.ndarray  # uint8 H×W×3
    picture_mm: RectMm
    object_mm: RectMm  # the object's extent
    outline_mm: tuple[PointMm, ...]  # the piece's cut line
    seams_mm: tuple[tuple[PointMm, PointMm], ...] = ()  # thin lines
    names_mm: tuple[tuple[PointMm, str], ...] = ()


@dataclass(frozen=True)
class PlanPage:
    """The content of a plan: a picture or none, and sections of (heading, paragraphs)."""

    placement: PlacementPicture | None
    sections: tuple[tuple[str, tuple[str, ...]], ...]


def lay_out_plan(plan: PlanPage, template: Template, sheet_id: str) -> PdfPage:
    """Lay out the plan on a page of the template's size."""
    (width, height), margin = template.page_mm, template.margin_mm
    texts = [TextLine(at_mm=(margin, margin + 5.4), size_mm=5.2, text="patchproof", bold=True)]
    texts.append(TextLine(at_mm=(margin + 39, margin + 5.4), size_mm=2.7, text=f"plan of sheet {sheet_id}", gray=0.35))
    lines, labels, boxes, pictures, top = [], [], [], (), margin + 10.0
    if plan.placement is not None:
        drawing_mm = margin, top, width - 2 * margin, PICTURE_SHARE * height
        lines, labels, pictures, box = _drawing(plan.placement, drawing_mm)
        boxes.append(box)
        top = box.rect_mm[1] + box.rect_mm[3] + 3.0
    for heading, paragraphs in plan.sections:
        texts.append(TextLine(at_mm=(margin, top + HEADING_MM), size_mm=HEADING_MM, text=heading, bold=True))
        top += HEADING_MM * LEADING + 1.2
        for paragraph in paragraphs:
            for line in wrap_text(paragraph, TEXT_MM, width - 2 * margin):
                texts.append(TextLine(at_mm=(margin, top + TEXT_MM), size_mm=TEXT_MM, text=line))
                top += TEXT_MM * LEADING
            top += 0.9
        top += 2.0
    all_boxes = (*boxes, *map(text_box, texts))
    layout = PageLayout(template.page_mm, ticks=tuple(lines), texts=(*texts, *labels), boxes=all_boxes)
    check_layout(layout.boxes, template.page_mm, margin)
    return PdfPage(layout, pictures)


def wrap_text(text: str, size_mm: float, width_mm: float) -> list[str]:
    """Break a text into lines no longer than `width_mm`."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and text_width_mm(longer, size_mm, False) > width_mm:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def _drawing(placement: PlacementPicture, area: RectMm):
    """(lines, labels, pictures, box) of the picture with outline and dimension chains, scaled into the area."""
    x, y, w, h = area
    left, up, wide, high = placement.picture_mm
    scale = min((w - BESIDE_MM) / wide, (h - ABOVE_MM) / high)
    if not scale > 0:
        raise Refused("a picture of the object", f"a picture of {wide:g} × {high:g} mm", "leave the plan out")
    corner = (x + (w - BESIDE_MM - scale * wide) / 2, y + ABOVE_MM)

    def to_page(point: PointMm) -> PointMm:
        return corner[0] + (point[0] - left) * scale, corner[1] + (point[1] - up) * scale

    sides = zip(placement.outline_mm, (*placement.outline_mm[1:], placement.outline_mm[0]), strict=True)
    lines = [Line((*to_page(a), *to_page(b)), 0.5) for a, b in sides]
    lines += [Line((*to_page(a), *to_page(b)), 0.25) for a, b in placement.seams_mm]
    labels = []
    for point, name in placement.names_mm:
        cx, cy = to_page(point)
        left_end = cx - text_width_mm(name, 2.8, True) / 2
        labels.append(TextLine(at_mm=(left_end, cy + 1.0), size_mm=2.8, text=name, bold=True))
    rect = (*corner, scale * wide, scale * high)
    (xs, ys), (x0, y0, w0, h0) = zip(*placement.outline_mm, strict=True), placement.object_mm
    across, down = (x0, min(xs), max(xs), x0 + w0), (y0, min(ys), max(ys), y0 + h0)
    for more_lines, more_labels in (_chain_above(across, to_page, rect), _chain_beside(down, to_page, rect)):
        lines, labels = lines + more_lines, labels + more_labels
    return lines, labels, ((rect, placement.picture),), Box("picture of the object", (x, y, w, ABOVE_MM + scale * high))


def edge_distances_mm(placement: PlacementPicture) -> dict[str, float]:
    """Distances from the piece to the edges of the object's side; negative where the piece overhangs."""
    xs, ys = zip(*placement.outline_mm, strict=True)
    x, y, w, h = placement.object_mm
    return {"left": min(xs) - x, "right": x + w - max(xs), "top": min(ys) - y, "bottom": y + h - max(ys)}


def _chain_above(stops: tuple[float, ...], to_page, rect: RectMm) -> tuple[list[Line], list[TextLine]]:
    row, lines, labels = rect[1] - 2.0, [], []
    for i, name in enumerate(("from left edge", "piece", "from right edge")):
        start, end = (to_page((x, 0))[0] for x in stops[i : i + 2])
        lines += [Line((start, row, end, row), 0.2), *(Line((s, row - 1, s, row + 1), 0.2) for s in (start, end))]
        text = f"{stops[i + 1] - stops[i]:.0f} mm {name}"
        # each label has its own row, so that those of narrow parts do not overlap
        middle = (start + end) / 2 - text_width_mm(text, 2.3, False) / 2
        middle = min(max(middle, rect[0]), rect[0] + rect[2] + BESIDE_MM - text_width_mm(text, 2.3, False))
        labels.append(TextLine(at_mm=(middle, row - 1.6 - (2 - i) * 3.1), size_mm=2.3, text=text))
    return lines, labels


def _chain_beside(stops: tuple[float, ...], to_page, rect: RectMm) -> tuple[list[Line], list[TextLine]]:
    column = rect[0] + rect[2] + 2.0
    lines, labels, free = [], [], rect[1]
    for i, name in enumerate(("from top", "piece", "from bottom")):
        start, end = (to_page((0, y))[1] for y in stops[i : i + 2])
        lines.append(Line((column, start, column, end), 0.2))
        lines += [Line((column - 1, s, column + 1, s), 0.2) for s in (start, end)]
        text, middle = f"{stops[i + 1] - stops[i]:.0f} mm", max((start + end) / 2 - 1.2, free)
        labels.append(TextLine(at_mm=(column + 2, middle + 2.3 * CAP_HEIGHT), size_mm=2.3, text=text))
        low = middle + 2.6 + 2.3 * CAP_HEIGHT
        labels.append(TextLine(at_mm=(column + 2, low), size_mm=2.0, text=name, gray=0.35))
        free = middle + 2.6 + 2.3 * (CAP_HEIGHT + DESCENT) + 0.6
    return lines, labels
