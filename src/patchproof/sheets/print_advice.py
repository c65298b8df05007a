"""Advice for printing and cutting a sheet, from its manifest and from the PDF.

In: a manifest; SHEET.pdf. Out: sentences; those that begin with "PROBLEM" name something that would print wrongly. The
PDF is opened by pikepdf, and every statement is checked in it: page size and boxes, the request not to scale, fonts,
images with their resolution, compression and color space. Left out on purpose: total ink and separations, which an RGB
file rightly leaves to the printer; and PDF/X, which is made for one intended press.
"""

import io
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from patchproof.base.errors import Refused
from patchproof.base.geometry import MM_PER_INCH
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.pdf_raster import call_within_limits

_MM = MM_PER_INCH / 72
_LOSSLESS = {"/FlateDecode", "/LZWDecode", "/RunLengthDecode", "/ASCII85Decode", "/ASCIIHexDecode"}


def sheet_advice(manifest: Manifest) -> list[str]:
    """Sentences for whoever prints and cuts this sheet, from its manifest; `pdf_advice` adds those about the PDF."""
    width, height = manifest.page_mm
    lines = [
        f"Print the {width:g} × {height:g} mm page at 100 %; markers, swatches and cut line stay "
        f"{_nearest_ink_mm(manifest):.1f} mm from its edge.",
        "Use matte white paper of 160 g/m² or more, color, best quality.",
        f"After printing both rulers must measure {manifest.ruler_mm[0]:g} and {manifest.ruler_mm[1]:g} mm.",
    ]
    if manifest.kind == "board":
        return [*lines, "Glue the uncut page to something flat and stiff."]
    if manifest.kind == "chart":
        return [*lines, "Cut nothing: lay the page flat, and photograph all of it in even light without shine."]
    lines += _cutting_lines(manifest)
    if manifest.plan_page is not None:
        whose = "" if manifest.page_code is None else f" of sheet {manifest.sheet_id}"
        page = f"Page {manifest.plan_page} is for people, on any paper"
        lines.append(f"{page}: where the piece{whose} goes and how to photograph it.")
    if manifest.design is None:
        lines.append("The piece carries no design: between its markers it stays white paper.")
    return lines


def _cutting_lines(manifest: Manifest) -> Iterator[str]:
    """A sentence about the pieces to cut out."""
    size = f"{manifest.cut_mm[2]:.1f} × {manifest.cut_mm[3]:.1f} mm"
    if manifest.tiles:
        pages = [tile.page for tile in manifest.tiles]
        yield (
            f"Cut the {len(pages)} tiles of pages {min(pages)} to {max(pages)} along the dashed lines, flaps and all, "
            f"and glue them to one piece of {size} as page 1 shows; page 1 stays whole."
        )
    elif manifest.page_code is not None:
        x, y = manifest.cut_mm[:2]
        yield (
            f"Cut each piece of the page along its own dashed line; that of sheet {manifest.sheet_id} is the one of "
            f"{size} whose corner lies {x:.0f} mm from the left and {y:.0f} mm from the top."
        )
    else:
        yield f"Cut the piece of {size} along the dashed line."


def _nearest_ink_mm(manifest: Manifest) -> float:
    """The distance from the page's edge to the nearest marker, swatch or cut line."""
    width, height = manifest.page_mm
    rects = [tile.cut_mm for tile in manifest.tiles] or [manifest.cut_mm]
    rects = [*rects, *(swatch.rect_mm for swatch in manifest.chart)]
    points = [point for marker in manifest.markers for point in marker.corners_mm]
    points += [(x + dx, y + dy) for x, y, w, h in rects for dx, dy in ((0, 0), (w, h))]
    return min(min(x, y, width - x, height - y) for x, y in points)


def pdf_advice(pdf_path: str | Path) -> list[str]:
    """Sentences for whoever prints the PDF, from its pages, fonts, images and colors."""
    return [
        *call_within_limits(pdf_path, partial(_lines_about, pdf_path)),
        "Total ink is not limited in the file: it is RGB, so the printer's own profile decides; black is RGB 0 0 0.",
        "Order: single-sided, full color, best quality, sRGB to your printer's profile, relative colorimetric intent.",
        "Switch off scaling, sharpening and all automatic color or photo enhancement; no lamination, no gloss.",
    ]


def _lines_about(pdf_path: str | Path) -> list[str]:
    import pikepdf

    try:
        with pikepdf.open(pdf_path) as pdf:
            return [*_page_lines(pdf), _scaling_line(pdf), *_font_lines(pdf), *_image_lines(pdf), _color_line(pdf)]
    except Exception as error:  # objects of unexpected types fail in many ways
        raise Refused("a PDF of a sheet", f"{pdf_path}, which cannot be read", "make the sheet again") from error


def _page_lines(pdf) -> Iterator[str]:
    sizes = [_size(page.mediabox) for page in pdf.pages]
    count = "1 page" if len(sizes) == 1 else f"{len(sizes)} pages"
    yield f"PDF {pdf.pdf_version}, {count} of {' and '.join(sorted(set(sizes)))} mm, true size (1:1)."
    for number, page in enumerate(pdf.pages, 1):
        boxes = [page.obj.get(f"/{name}Box") for name in ("Trim", "Bleed")]
        if None in boxes:
            yield f"PROBLEM: page {number} has no trim and bleed box."
        elif any([float(v) for v in box] != [float(v) for v in page.mediabox] for box in boxes):
            yield f"PROBLEM: trim and bleed box of page {number} differ from the page: it would be cut elsewhere."
        if "/UserUnit" in page.obj and float(page.obj.UserUnit) != 1:
            yield f"PROBLEM: page {number} has a UserUnit, which many printers ignore."
    yield "Trim box and bleed box are given; no ink reaches the edge, so no bleed and no crop marks are needed."


def _scaling_line(pdf) -> str:
    if pdf.Root.get("/ViewerPreferences", {}).get("/PrintScaling") == "/None":
        return "The file asks viewers not to scale it (PrintScaling None); still check that 100 % is set."
    return "PROBLEM: the file does not ask viewers not to scale it (PrintScaling None is missing)."


def _font_lines(pdf) -> Iterator[str]:
    names: dict[str, bool] = {}
    for page in pdf.pages:
        for font in page.resources.get("/Font", {}).values():
            names[str(font.get("/BaseFont", "?")).lstrip("/").split("+")[-1]] = _is_embedded(font)
    missing = sorted(name for name, embedded in names.items() if not embedded)
    if missing:
        yield f"PROBLEM: fonts that are not embedded: {', '.join(missing)}."
    elif names:
        yield f"All fonts are embedded ({', '.join(sorted(names))})."


def _is_embedded(font) -> bool:
    inner = font.DescendantFonts[0] if "/DescendantFonts" in font else font
    descriptor = inner.get("/FontDescriptor", {})
    return any(f"/FontFile{kind}" in descriptor for kind in ("", "2", "3"))


def _image_lines(pdf) -> Iterator[str]:
    for number, page in enumerate(pdf.pages, 1):
        resources = page.resources.get("/XObject", {})
        for name, (width_mm, height_mm) in _drawn_objects(page):
            image = resources.get(name)
            if image is None or image.get("/Subtype") != "/Image":
                continue
            ppi = min(int(image.Width) / width_mm, int(image.Height) / height_mm) * MM_PER_INCH
            yield (
                f"Page {number}: an image of {int(image.Width)} × {int(image.Height)} pixels on {width_mm:.1f} × "
                f"{height_mm:.1f} mm, {ppi:.0f} ppi; {_compression(image)}; {_profile(image.get('/ColorSpace'))}; "
                "its pixels must stay as they are, so do not resample or sharpen."
            )


def _drawn_objects(page) -> Iterator[tuple[str, tuple[float, float]]]:
    """The name of every drawn XObject and its (width, height) in mm, by the current transformation matrix."""
    import pikepdf

    matrix, saved = pikepdf.Matrix(), []
    for operands, operator in pikepdf.parse_content_stream(page):
        word = str(operator)
        if word == "q":
            saved.append(matrix)
        elif word == "Q":
            matrix = saved.pop()
        elif word == "cm":
            matrix = pikepdf.Matrix(*(float(v) for v in operands)) @ matrix
        elif word == "Do":
            yield str(operands[0]), (_MM * math.hypot(matrix.a, matrix.b), _MM * math.hypot(matrix.c, matrix.d))


def _compression(image) -> str:
    names = {str(name) for name in image.Filter.wrap_in_array()} if "/Filter" in image else set()
    return "lossless" if names <= _LOSSLESS else f"PROBLEM: lossy ({', '.join(sorted(names - _LOSSLESS))})"


def _profile(space: Any) -> str:
    if space is None or str(space.wrap_in_array()[0]) != "/ICCBased":
        return "PROBLEM: no ICC profile"
    return f"ICC profile {_profile_name(space[1])}"


def _color_line(pdf) -> str:
    spaces = [page.resources.get("/ColorSpace", {}).get("/DefaultRGB") for page in pdf.pages]
    if any(space is None for space in spaces):
        return "PROBLEM: texts, markers and swatches are device RGB without a profile."
    names = sorted({_profile_name(space[1]) for space in spaces})
    return f"Texts, markers and swatches are vector graphics, RGB with the ICC profile {', '.join(names)} (DefaultRGB)."


def _profile_name(stream) -> str:
    from PIL import ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(stream.read_bytes()))
        return ImageCms.getProfileDescription(profile).strip()
    except (ImageCms.PyCMSError, OSError):
        return "PROBLEM: broken"


def _size(box) -> str:
    x0, y0, x1, y1 = (float(v) for v in box)
    return f"{round((x1 - x0) * _MM, 1):g} × {round((y1 - y0) * _MM, 1):g}"
