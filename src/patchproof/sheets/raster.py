"""The way back: a sheet's PDF as pixels on an exact millimeter grid, and the manifest that it carries.

In: a PDF and a resolution. Out: uint8 H×W×3 sRGB. The page is rendered by PDFium, which did not write it. PDFium
stretches a page to a whole number of pixels (0.2 mm across A4 at 150 dpi), so the part wanted is first made a page of
its own whose size is a whole number of pixels; then pixel and millimeter differ by a scale alone.
Left out on purpose: threads. PDFium is not thread-safe; render in processes.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.geometry import MM_PER_INCH
from patchproof.input import LARGEST_JSON, is_file
from patchproof.sheets.manifest import Manifest, Tile
from patchproof.sheets.pdf import ATTACHMENT, POINTS_PER_MM, numbered
from patchproof.strict import Refused, validated

LARGEST_PX = 20_000  # along a side; more would be gigabytes


def page_pixels(pdf_path: str | Path, page: int = 1, dpi: float = 150.0) -> np.ndarray:
    """A page (from 1) with pixel = mm × dpi / 25.4; the last row and column may pass the page's edge."""
    with _opened_page(pdf_path, page) as opened:
        width, height = (math.ceil(side / 72 * dpi - 1e-3) for side in opened.get_size())
        return _render(opened, (0.0, 0.0, width * 72 / dpi, height * 72 / dpi), (width, height))


def page_count(pdf_path: str | Path) -> int:
    """How many pages a PDF has."""
    with _opened(pdf_path) as pdf:
        return len(pdf)


def piece_pixels(pdf_path: str | Path, manifest: Manifest, dpi: float) -> np.ndarray:
    """The piece alone: its cut line is exactly the picture's border, so that pixel = mm × width_px / width_mm.

    The number of pixels is the nearest whole one, so each axis' resolution differs from `dpi` by at most half a pixel.
    """
    width, height = (max(round(side / MM_PER_INCH * dpi), 1) for side in manifest.cut_mm[2:])
    _refuse_size((width, height))
    if not manifest.tiles:
        page = manifest.design.page if manifest.design else 1
        return _part_pixels(pdf_path, page, manifest.cut_mm, (width, height))
    pixels = np.full((height, width, 3), 255, np.uint8)
    px_per_mm = np.array([width, height]) / manifest.cut_mm[2:]
    for tile in manifest.tiles:
        start_mm = _piece_from_page(manifest, tile, tile.cut_mm[:2])
        # whole pixels that begin on the tile; its picture runs on far enough on its flaps to fill the last one
        first = np.ceil(start_mm * px_per_mm - 1e-6).astype(int)
        last = np.ceil((start_mm + tile.cut_mm[2:]) * px_per_mm - 1e-6).astype(int).clip(max=[width, height])
        corner = np.array(tile.cut_mm[:2]) + first / px_per_mm - start_mm
        wide, high = (last - first).tolist()
        rect = (*corner, wide / px_per_mm[0], high / px_per_mm[1])
        pixels[first[1] : last[1], first[0] : last[0]] = _part_pixels(pdf_path, tile.page, rect, (wide, high))
    return pixels


def _part_pixels(pdf_path: str | Path, number: int, rect_mm: tuple, size_px: tuple[int, int]) -> np.ndarray:
    with _opened_page(pdf_path, number) as page:
        return _render(page, tuple(float(v) * POINTS_PER_MM for v in rect_mm), size_px)


def _piece_from_page(manifest: Manifest, tile: Tile, point_mm: tuple[float, float]) -> np.ndarray:
    """A point of a tile's page in piece millimeters."""
    # the cut line and the first tile's design lie on one page: they differ by the frame that pieces once had
    frame = np.array(manifest.tiles[0].page_from_design_mm)[:, 2] - manifest.cut_mm[:2]
    return np.array(point_mm) - np.array(tile.page_from_design_mm)[:, 2] + frame


def attached_manifest(pdf_path: str | Path, sheet_id: str | None = None) -> Manifest:
    """The manifest inside a sheet's PDF; of several designs' page that of `sheet_id`, else the first."""
    import pikepdf

    _existing(pdf_path)
    try:
        with pikepdf.open(pdf_path) as pdf:
            names = sorted(set(pdf.attachments) & {ATTACHMENT, *(numbered(ATTACHMENT, i) for i in range(99))})
            texts = [json.loads(_unpacked(pdf.attachments[name].get_file().obj)) for name in names]
    except pikepdf.PdfError as error:
        raise Refused("a PDF of a sheet", f"{pdf_path}, which cannot be read", "make the sheet again") from error
    except Exception as error:  # objects of other kinds than they should be fail in many ways
        raise Refused(f"a PDF with {ATTACHMENT} attached", f"{pdf_path} without", "make the sheet again") from error
    if not texts:
        raise Refused(f"a PDF with {ATTACHMENT} attached", f"{pdf_path} without", "make the sheet again")
    manifests = [validated(Manifest, data, f"{name} of {pdf_path}") for name, data in zip(names, texts, strict=True)]
    return next((manifest for manifest in manifests if manifest.sheet_id == sheet_id), manifests[0])


def _unpacked(stream) -> bytes:
    """An attachment's bytes, as far as a manifest may be long: pikepdf's own reading has no bound."""
    packing = stream.get("/Filter")
    if packing is None:
        return stream.read_raw_bytes()
    if str(packing) != "/FlateDecode":
        raise ValueError(f"packed by {packing}")
    return zlib.decompressobj().decompress(stream.read_raw_bytes(), LARGEST_JSON)


def _existing(pdf_path: str | Path) -> None:
    if not is_file(pdf_path):
        raise Refused("a PDF of a sheet", f"no file at {pdf_path}", "check the path")


@contextmanager
def _opened(pdf_path: str | Path) -> Iterator[Any]:
    import pypdfium2

    _existing(pdf_path)
    try:
        with pypdfium2.PdfDocument(str(pdf_path)) as pdf:
            yield pdf
    except pypdfium2.PdfiumError as error:
        raise Refused("a PDF of a sheet", f"{pdf_path}, which cannot be read", "make the sheet again") from error


@contextmanager
def _opened_page(pdf_path: str | Path, page: int) -> Iterator[Any]:
    with _opened(pdf_path) as pdf:
        if not 1 <= page <= len(pdf):
            raise Refused(f"a page from 1 to {len(pdf)} of {pdf_path}", f"{page}", "ask for another page")
        yield pdf[page - 1]


def _render(page, rect_points: tuple[float, ...], size_px: tuple[int, int]) -> np.ndarray:
    """The rectangle (x, y, width, height from the page's top-left, in points) as exactly that many pixels."""
    import pypdfium2
    import pypdfium2.raw as pdfium

    _refuse_size(size_px)
    left, _, _, top = page.get_mediabox()
    x, y, w, h = rect_points
    box = (left + x, top - y - h, left + x + w, top - y)
    page.set_mediabox(*box)
    page.set_cropbox(*box)
    bitmap = pypdfium2.PdfBitmap.new_native(*size_px, pdfium.FPDFBitmap_BGR)
    bitmap.fill_rect((255, 255, 255, 255), 0, 0, *size_px)
    pdfium.FPDF_RenderPageBitmap(bitmap, page, 0, 0, *size_px, 0, pdfium.FPDF_ANNOT | pdfium.FPDF_REVERSE_BYTE_ORDER)
    return bitmap.to_numpy().copy()


def _refuse_size(size_px: tuple[int, int]) -> None:
    if not 1 <= min(size_px) <= max(size_px) <= LARGEST_PX:
        got = f"{size_px[0]} × {size_px[1]}"
        raise Refused(f"at most {LARGEST_PX} pixels along a side, and one at least", got, "lower the resolution")
