"""Ink: a page layout and a design become the bytes of one PDF page at true size.

Each marker, and the QR code, is one path of black runs that touch, and a swatch one path of two halves: readers snap
a lone rectangle to whole pixels but antialias a path of several, which keeps marker corners within hundredths of a
millimetre. The design is embedded losslessly, pixel for pixel, without interpolation. All colours are sRGB and say
so: the design's colour space is ICCBased, and the page's DefaultRGB gives vector colours the same one. PrintScaling
None asks viewers not to scale. Nothing depends on time, place or hash order: equal input gives equal bytes. PDF
points (1/72 inch, y up) and their conversion exist here alone.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.sheet.fonts import font_name
from patchproof.sheet.page import CUT_LINE_MM, PageLayout
from patchproof.sheet.piece import marker_rects_mm
from patchproof.sheet.swatches import RectMm, Srgb

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

POINTS_PER_MM = 72 / 25.4
ATTACHMENT = "sheet.json"


def page_pdf(layout: PageLayout, design: np.ndarray | None, title: str, manifest_json: str) -> bytes:
    """The finished PDF: the page, the uint8 H×W×3 design (None leaves white paper) and the manifest attached."""
    return _finished(_drawn(layout, design, title), manifest_json.encode())


def srgb_profile() -> bytes:
    """An ICC profile of sRGB without the day it was made."""
    from PIL import ImageCms

    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    # ICC.1 7.2: bytes 24-35 are date and time (here 2000-01-01), 84-99 the profile's id (zeros: not computed)
    profile[24:36] = b"".join(value.to_bytes(2, "big") for value in (2000, 1, 1, 0, 0, 0))
    profile[84:100] = bytes(16)
    return bytes(profile)


def _drawn(layout: PageLayout, design: np.ndarray | None, title: str) -> bytes:
    from reportlab import rl_config
    from reportlab.pdfgen.canvas import Canvas

    size = tuple(side * POINTS_PER_MM for side in layout.page_mm)
    buffer = io.BytesIO()
    before, rl_config.useA85 = rl_config.useA85, 0  # ASCII85 would make the image a quarter larger
    try:
        canvas = Canvas(buffer, pagesize=size, invariant=1, pdfVersion=(1, 7), pageCompression=1, lang="en")
        canvas.setTitle(title)
        canvas.setViewerPreference("PrintScaling", "None")
        canvas.setTrimBox((0, 0, *size))
        canvas.setBleedBox((0, 0, *size))
        # from here on millimetres with y up
        canvas.scale(POINTS_PER_MM, POINTS_PER_MM)
        _draw(canvas, layout, design)
        canvas.showPage()
        canvas.save()
    finally:
        rl_config.useA85 = before
    return buffer.getvalue()


def _draw(canvas: Canvas, layout: PageLayout, design: np.ndarray | None) -> None:
    height = layout.page_mm[1]
    if design is not None:
        _image(canvas, design, layout.design_mm, height)
    for rect, srgb in layout.swatches:
        x, y, w, h = rect
        _fill(canvas, [(x, y, w / 2, h), (x + w / 2, y, w / 2, h)], srgb, height)
    for marker in layout.markers:
        _fill(canvas, marker_rects_mm(marker), (0.0, 0.0, 0.0), height)
    for rects in (layout.qr_mm, layout.squares_mm):
        if rects:
            _fill(canvas, rects, (0.0, 0.0, 0.0), height)
    canvas.setStrokeGray(0)
    for line in layout.ticks:
        x0, y0, x1, y1 = line.ends_mm
        canvas.setLineWidth(line.width_mm)
        canvas.line(x0, height - y0, x1, height - y1)
    _outlines(canvas, layout)
    for line in layout.texts:
        canvas.setFillGray(line.gray)
        canvas.setFont(font_name(line.bold), line.size_mm)
        canvas.drawString(line.at_mm[0], height - line.at_mm[1], line.text)


def _outlines(canvas: Canvas, layout: PageLayout) -> None:
    """The card's outline, and the cut line just outside the piece."""
    height = layout.page_mm[1]
    canvas.setStrokeGray(0.45)
    if layout.card_mm is not None:
        x, y, w, h = layout.card_mm
        canvas.setLineWidth(0.2)
        canvas.roundRect(x, height - y - h, w, h, layout.card_radius_mm)
    if layout.cut_mm is not None:
        x, y, w, h = layout.cut_mm
        half = CUT_LINE_MM / 2
        canvas.setLineWidth(CUT_LINE_MM)
        canvas.setDash(2.0, 1.5)
        canvas.rect(x - half, height - y - h - half, w + 2 * half, h + 2 * half)
        canvas.setDash()


def _image(canvas: Canvas, design: np.ndarray, rect: RectMm, height: float) -> None:
    from PIL import Image
    from reportlab.lib.utils import ImageReader

    x, y, w, h = rect
    canvas.drawImage(ImageReader(Image.fromarray(design)), x, height - y - h, w, h, mask=None)


def _fill(canvas: Canvas, rects: Any, srgb: Srgb, height: float) -> None:
    path = canvas.beginPath()
    for x, y, w, h in rects:
        path.rect(x, height - y - h, w, h)
    canvas.setFillColorRGB(*srgb)
    canvas.drawPath(path, stroke=0, fill=1)


def _finished(drawn: bytes, manifest_json: bytes) -> bytes:
    """Colour spaces, attachment and plain metadata, which reportlab cannot write."""
    import pikepdf
    from pikepdf import Array, Name

    with pikepdf.open(io.BytesIO(drawn)) as pdf:
        icc = pdf.make_stream(srgb_profile(), N=3, Alternate=Name.DeviceRGB)
        space = pdf.make_indirect(Array([Name.ICCBased, icc]))
        resources = pdf.pages[0].obj.Resources
        resources.ColorSpace = pikepdf.Dictionary(DefaultRGB=space)
        for image in resources.get("/XObject", {}).values():
            image.ColorSpace = space
        pdf.attachments[ATTACHMENT] = pikepdf.AttachedFileSpec(
            pdf,
            manifest_json,
            filename=ATTACHMENT,
            mime_type="application/json",
            relationship=Name.Data,
            description="geometry and promise of this sheet",
        )
        for key in ("/CreationDate", "/ModDate", "/Author", "/Subject", "/Keywords", "/Creator"):
            if key in pdf.docinfo:
                del pdf.docinfo[key]
        _drop_unused_font(pdf)
        buffer = io.BytesIO()
        pdf.save(buffer, deterministic_id=True, compress_streams=True)
    return buffer.getvalue()


def _drop_unused_font(pdf: Any) -> None:
    """Take out Helvetica, which reportlab selects at the top of every page: unused, but not embedded either."""
    import pikepdf

    page = pdf.pages[0]
    fonts = page.obj.Resources.Font
    loose = [name for name, font in fonts.items() if "/FontDescriptor" not in font]
    content = [
        instruction
        for instruction in pikepdf.parse_content_stream(page)
        if not (str(instruction.operator) == "Tf" and str(instruction.operands[0]) in loose)
    ]
    page.Contents = pdf.make_stream(pikepdf.unparse_content_stream(content))
    for name in loose:
        del fonts[name]
