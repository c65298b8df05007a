"""Render a sheet's PDF to pixels on an exact millimeter grid, and read the manifest that is attached to it.

The page is rendered by PDFium, which did not write it. PDFium stretches a page to whole pixels (0.2 mm across A4 at 150
dpi), so the requested part is first made a page of whole pixels, which are millimeters times a scale.
PDFs may come from anybody: each call reads the file in a child process within limits of time and memory.
"""

import json
import math
import os
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.errors import Refused, TimeLimitExceeded
from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.input import MAX_JSON_BYTES, ReturnType, file_size, run_in_child
from patchproof.base.validation import validate_model
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.pdf import ATTACHMENT, POINTS_PER_MM, numbered_name

MAX_SIDE_PX = 20_000
MAX_PAGE_PX = 160_000_000  # 0.5 GB, A2 at 600 dpi
_EXPECTED = f"a PDF with {ATTACHMENT} attached"
_NO_CROP = (-1e6, -1e6, 1e6, 1e6)
_View = tuple[tuple[float, float, float, float], tuple[int, int]]  # a rectangle (x, y, width, height) and its pixels


def rasterize_page(pdf_path: str | Path, number: int = 1, dpi: float = 150.0) -> np.ndarray:
    """Render page `number` (from 1) with pixel = mm × dpi / 25.4; the last row and column may exceed the page."""

    def whole_page(*sides: float) -> _View:
        width, height = (math.ceil(side / 72 * dpi - 1e-3) for side in sides)
        return (0.0, 0.0, width * 72 / dpi, height * 72 / dpi), (width, height)

    return _render(pdf_path, number, whole_page)


def page_count(pdf_path: str | Path) -> int:
    """The number of pages of a PDF."""
    return _call_with_pdf(pdf_path, lambda pdfium, pdf: pdfium.FPDF_GetPageCount(pdf))


def rasterize_piece(pdf_path: str | Path, manifest: Manifest, dpi: float) -> np.ndarray:
    """Render the piece only: its cut line is exactly the picture's border, which is rounded to whole pixels."""
    width, height = (max(round(side / MM_PER_INCH * dpi), 1) for side in manifest.cut_mm[2:])
    _refuse_size((width, height))
    if not manifest.tiles:
        return _part_pixels(pdf_path, manifest.design.page if manifest.design else 1, manifest.cut_mm, (width, height))
    pixels = np.full((height, width, 3), 255, np.uint8)
    px_per_mm = np.array([width, height]) / manifest.cut_mm[2:]
    for tile in manifest.tiles:
        start_mm = np.array(tile.cut_mm[:2]) - np.array(tile.page_from_design_mm)[:, 2]  # in piece millimeters
        # whole pixels that begin on the tile; its picture extends far enough over the flaps to fill the last one
        first = np.ceil(start_mm * px_per_mm - 1e-6).astype(int)
        last = np.ceil((start_mm + tile.cut_mm[2:]) * px_per_mm - 1e-6).astype(int).clip(max=[width, height])
        corner = np.array(tile.cut_mm[:2]) + first / px_per_mm - start_mm
        wide, high = (last - first).tolist()
        rect = (*corner, wide / px_per_mm[0], high / px_per_mm[1])
        pixels[first[1] : last[1], first[0] : last[0]] = _part_pixels(pdf_path, tile.page, rect, (wide, high))
    return pixels


def _part_pixels(pdf_path: str | Path, number: int, rect_mm: tuple, size_px: tuple[int, int]) -> np.ndarray:
    x, y, w, h = (float(v) * POINTS_PER_MM for v in rect_mm)
    return _render(pdf_path, number, lambda *_: ((x, y, w, h), size_px))


def attached_manifests(pdf_path: str | Path) -> list[Manifest]:
    """Read the manifests attached to a sheet's PDF, one for each design on its page."""
    if not (texts := call_within_limits(pdf_path, partial(_attached_texts, pdf_path))):
        raise Refused(_EXPECTED, f"{pdf_path} without one", "make the sheet again")
    return [validate_model(Manifest, data, f"{name} of {pdf_path}") for name, data in texts.items()]


def _attached_texts(pdf_path: str | Path) -> dict[str, Any]:
    """The JSON of the attached manifests by name, in their order."""
    import pikepdf

    try:
        with pikepdf.open(pdf_path) as pdf:
            names = sorted(set(pdf.attachments) & {ATTACHMENT, *(numbered_name(ATTACHMENT, i) for i in range(99))})
            if any(page.get("/UserUnit", 1) != 1 for page in pdf.pages):
                raise ValueError("pages in another unit")
            return {name: json.loads(_decompress(pdf.attachments[name].get_file().obj)) for name in names}
    except pikepdf.PdfError as error:
        raise _unreadable(pdf_path) from error
    except Exception as error:  # objects of unexpected types fail in many ways
        raise Refused(_EXPECTED, f"{pdf_path} with one that cannot be read", "make the sheet again") from error


def _decompress(stream) -> bytes:
    """An attachment's bytes, up to the largest size of a manifest: pikepdf's own decompression has no limit."""
    if (compression := stream.get("/Filter")) is None:
        return stream.read_raw_bytes()
    if str(compression) != "/FlateDecode":
        raise ValueError(f"compressed by {compression}")
    return zlib.decompressobj().decompress(stream.read_raw_bytes(), MAX_JSON_BYTES)


def call_within_limits(pdf_path: str | Path, work: Callable[[], ReturnType]) -> ReturnType:
    """Call `work` on a PDF in a child process; refused beyond its limits: few lines may draw a million forms."""
    try:
        if not file_size(pdf_path, 1 << 62):
            raise _unreadable(pdf_path)
        return run_in_child(work)
    except FileNotFoundError as error:
        raise Refused("a PDF of a sheet", str(error), "check the path") from error
    except (TimeLimitExceeded, MemoryError) as error:
        expected = "a page that can be drawn in time and memory"
        raise Refused(expected, f"{pdf_path}, which takes {error}", "make the sheet again") from None


def _unreadable(pdf_path: str | Path) -> Refused:
    return Refused("a PDF of a sheet", f"{pdf_path}, which cannot be read", "make the sheet again")


def _call_with_pdf(pdf_path: str | Path, work: Callable[[Any, Any], ReturnType]) -> ReturnType:
    """Call `work` with PDFium and its handle of a file, in a child process, whose end closes it."""
    import pypdfium2.raw as pdfium

    def call() -> ReturnType:
        if not (pdf := pdfium.FPDF_LoadDocument(os.fsencode(pdf_path), None)):
            raise _unreadable(pdf_path)
        return work(pdfium, pdf)

    return call_within_limits(pdf_path, call)


def _render(pdf_path: str | Path, number: int, view: Callable[[float, float], _View]) -> np.ndarray:
    """Render what `view` chooses of a page by its width and height in points."""

    def call(pdfium, pdf) -> np.ndarray:
        def shown() -> np.ndarray:
            """Left, top, right and bottom of the media box, the page's own or inherited, within a crop box."""
            box = pdfium.FS_RECTF()
            pdfium.FPDF_GetPageBoundingBox(page, box)
            return np.array([box.left, box.top, box.right, box.bottom])

        pages = pdfium.FPDF_GetPageCount(pdf)
        if not 1 <= number <= pages:
            raise Refused(f"a page from 1 to {pages} of {pdf_path}", f"{number}", "ask for another page")
        if not (page := pdfium.FPDF_LoadPage(pdf, number - 1)):
            raise _unreadable(pdf_path)
        cropped = shown()
        pdfium.FPDFPage_SetCropBox(page, *_NO_CROP)
        left, top, right, bottom = whole = shown()
        if pdfium.FPDFPage_GetRotation(page) or np.abs(whole - cropped).max() > 0.01:
            raise Refused("a page as the sheet was made", f"{pdf_path} with one turned or cropped", "make it again")
        (x, y, w, h), (width, height) = view(right - left, top - bottom)
        _refuse_size((width, height))
        pdfium.FPDFPage_SetMediaBox(page, left + x, top - y - h, left + x + w, top - y)
        pixels = np.full((height, width, 3), 255, np.uint8)
        bitmap = pdfium.FPDFBitmap_CreateEx(width, height, pdfium.FPDFBitmap_BGR, pixels.ctypes.data, 3 * width)
        flags = pdfium.FPDF_ANNOT | pdfium.FPDF_REVERSE_BYTE_ORDER
        pdfium.FPDF_RenderPageBitmap(bitmap, page, 0, 0, width, height, 0, flags)
        return pixels

    return _call_with_pdf(pdf_path, call)


def _refuse_size(size_px: tuple[int, int]) -> None:
    width, height = size_px
    if not 1 <= min(size_px) <= max(size_px) <= MAX_SIDE_PX or width * height > MAX_PAGE_PX:
        expected = f"1 to {MAX_SIDE_PX} pixels along a side, and at most {MAX_PAGE_PX / 1e6:g} million in total"
        raise Refused(expected, f"{width} × {height}", "lower the resolution")
