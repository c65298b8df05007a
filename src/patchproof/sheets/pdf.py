"""Draw page layouts and designs as the bytes of a PDF at true size.

Each marker, and the QR code, is one path of black runs that touch, and a swatch one path of two halves: readers snap
a single rectangle to whole pixels but antialias a path of several, which keeps marker corners within hundredths of a
millimeter. The design is embedded losslessly, pixel for pixel, without interpolation. All colors are declared as sRGB:
the design's color space is ICCBased, and the page's DefaultRGB gives vector colors the same one. PrintScaling None asks
viewers not to scale. Nothing depends on time, machine or hash order: equal input gives equal bytes. Only this module
and `pdf_raster` know PDF points (1/72 inch, y up).
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from patchproof.base.geometry import MM_PER_INCH
from patchproof.sheets.layout import PageLayout, drawable_text, font_name
from patchproof.sheets.page import CUT_LINE_MM
from patchproof.sheets.piece import marker_rects_mm
from patchproof.sheets.rects import RectMm, Srgb, grow_rect

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

POINTS_PER_MM = 72 / MM_PER_INCH
ATTACHMENT = "sheet.json"
_DESCRIPTION = "geometry and promise of this sheet"


def numbered_name(name: str, index: int) -> str:
    """The name of file `index`, from 0, of several: sheet_1.json for sheet.json and 0."""
    stem, dot, suffix = name.rpartition(".")
    return f"{stem}_{index + 1}{dot}{suffix}"


@dataclass(frozen=True)
class PdfPage:
    """A page and its pictures (rectangle in mm, uint8 H×W×3 sRGB); `window_pictures` are clipped at the window."""

    layout: PageLayout
    pictures: tuple[tuple[RectMm, np.ndarray], ...] = ()
    window_pictures: tuple[tuple[RectMm, np.ndarray], ...] = ()


def srgb_profile() -> bytes:
    """An ICC profile of sRGB with a fixed date."""
    from PIL import ImageCms

    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    # ICC.1 7.2: bytes 24-35 are date and time (here 2000-01-01), 84-99 the profile's id (zeros: not computed)
    profile[24:36] = b"".join(value.to_bytes(2, "big") for value in (2000, 1, 1, 0, 0, 0))
    profile[84:100] = bytes(16)
    return bytes(profile)


def _draw_pages(pages: Sequence[PdfPage], title: str) -> bytes:
    from reportlab import rl_config
    from reportlab.pdfgen.canvas import Canvas

    buffer = io.BytesIO()
    use_a85, rl_config.useA85 = rl_config.useA85, 0  # ASCII85 would make images a quarter larger
    try:
        canvas = Canvas(buffer, invariant=1, pdfVersion=(1, 7), pageCompression=1, lang="en")
        canvas.setTitle(title)
        canvas.setViewerPreference("PrintScaling", "None")
        for page in pages:
            width, height = (side * POINTS_PER_MM for side in page.layout.page_mm)
            canvas.setPageSize((width, height))
            canvas.setTrimBox((0, 0, width, height))
            canvas.setBleedBox((0, 0, width, height))
            canvas.scale(POINTS_PER_MM, POINTS_PER_MM)  # from here on millimeters, y up
            _draw_page(canvas, page)
            canvas.showPage()
        canvas.save()
    finally:
        rl_config.useA85 = use_a85
    return buffer.getvalue()


def _draw_page(canvas: "Canvas", page: PdfPage) -> None:
    layout, height = page.layout, page.layout.page_mm[1]
    _draw_parts(canvas, page.pictures, layout.swatches, layout.markers, height)
    for rects in (layout.qr_mm, layout.squares_mm):
        if rects:
            _fill_rects(canvas, rects, (0.0, 0.0, 0.0), height)
    if layout.window is not None:
        x, y, w, h = layout.window.rect_mm
        canvas.saveState()
        path = canvas.beginPath()
        path.rect(x, height - y - h, w, h)
        canvas.clipPath(path, stroke=0, fill=0)
        _draw_parts(canvas, page.window_pictures, (), layout.window.markers, height)
        canvas.restoreState()
    canvas.setStrokeGray(0)
    for line in layout.ticks:
        x0, y0, x1, y1 = line.ends_mm
        canvas.setLineWidth(line.width_mm)
        canvas.line(x0, height - y0, x1, height - y1)
    canvas.setStrokeGray(0.45)
    for rect in layout.cuts_mm:
        x, y, w, h = grow_rect(rect, CUT_LINE_MM / 2)  # just outside of the cut
        canvas.setLineWidth(CUT_LINE_MM)
        canvas.setDash(2.0, 1.5)
        canvas.rect(x, height - y - h, w, h)
        canvas.setDash()
    for line in layout.texts:
        canvas.setFillGray(line.gray)
        canvas.setFont(font_name(line.bold), line.size_mm)
        canvas.drawString(line.at_mm[0], height - line.at_mm[1], drawable_text(line.text, line.bold))


def _draw_parts(canvas: "Canvas", pictures, swatches, markers, height: float) -> None:
    from PIL import Image
    from reportlab.lib.utils import ImageReader

    for (x, y, w, h), pixels in pictures:
        canvas.drawImage(ImageReader(Image.fromarray(pixels)), x, height - y - h, w, h, mask=None)
    for (x, y, w, h), srgb in swatches:
        _fill_rects(canvas, [(x, y, w / 2, h), (x + w / 2, y, w / 2, h)], srgb, height)
    for marker in markers:
        _fill_rects(canvas, marker_rects_mm(marker), (0.0, 0.0, 0.0), height)


def _fill_rects(canvas: "Canvas", rects: Any, srgb: Srgb, height: float) -> None:
    path = canvas.beginPath()
    for x, y, w, h in rects:
        path.rect(x, height - y - h, w, h)
    canvas.setFillColorRGB(*srgb)
    canvas.drawPath(path, stroke=0, fill=1)


def pages_pdf(pages: Sequence[PdfPage], title: str, attachments: dict[str, str]) -> bytes:
    """Make a PDF of pages with `attachments` (texts by file name). pikepdf adds what reportlab cannot write."""
    import pikepdf
    from pikepdf import Array, Name

    with pikepdf.open(io.BytesIO(_draw_pages(pages, title))) as pdf:
        icc = pdf.make_stream(srgb_profile(), N=3, Alternate=Name.DeviceRGB)
        space = pdf.make_indirect(Array([Name.ICCBased, icc]))
        for page in pdf.pages:
            resources = page.obj.Resources
            resources.ColorSpace = pikepdf.Dictionary(DefaultRGB=space)
            for image in resources.get("/XObject", {}).values():
                image.ColorSpace = space
        for name, text in attachments.items():
            about = {"filename": name, "mime_type": "application/json", "description": _DESCRIPTION}
            file_spec: Any = pikepdf.AttachedFileSpec  # its stub lacks the relationship
            pdf.attachments[name] = file_spec(pdf, text.encode(), relationship=Name.Data, **about)
        for key in {"/CreationDate", "/ModDate", "/Author", "/Subject", "/Keywords", "/Creator"} & set(pdf.docinfo):
            del pdf.docinfo[key]
        _drop_unused_font(pdf)
        buffer = io.BytesIO()
        pdf.save(buffer, deterministic_id=True, compress_streams=True)
    return buffer.getvalue()


def _drop_unused_font(pdf: Any) -> None:
    """Remove Helvetica, which reportlab selects at the top of every page without using or embedding it."""
    import pikepdf

    fonts = pdf.pages[0].obj.Resources.Font  # one dictionary that all pages share
    not_embedded = [name for name, font in fonts.items() if "/FontDescriptor" not in font]
    for page in pdf.pages:
        content = pikepdf.parse_content_stream(page)
        content = [i for i in content if str(i.operator) != "Tf" or str(i.operands[0]) not in not_embedded]
        page.Contents = pdf.make_stream(pikepdf.unparse_content_stream(content))
    for name in not_embedded:
        del fonts[name]
