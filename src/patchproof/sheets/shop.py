"""What a print shop needs to know of a sheet, read from the PDF itself.

In: SHEET.pdf. Out: sentences; those that begin with "PROBLEM" name what would not print as it should. The file is
opened by pikepdf and every statement is looked up in it: page size and boxes, the wish not to be scaled, fonts, images
with their resolution, compression and color space. Left out on purpose: total ink and separations, which an RGB file
leaves to the printer, as it should; and PDF/X, which asks for one intended press.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.strict import Refused

_MM = MM_PER_INCH / 72
_LOSSLESS = {"/FlateDecode", "/LZWDecode", "/RunLengthDecode", "/ASCII85Decode", "/ASCIIHexDecode"}


def shop_lines(pdf_path: str | Path) -> list[str]:
    """The sentences for the PDF at that path."""
    import pikepdf

    try:
        with pikepdf.open(pdf_path) as pdf:
            lines = [*_pages(pdf), _scaling(pdf), *_fonts(pdf), *_images(pdf), _vector_color(pdf)]
    except Exception as error:  # objects of other kinds than they should be fail in many ways
        raise Refused("a PDF of a sheet", f"{pdf_path}, which cannot be read", "make the sheet again") from error
    return [
        *lines,
        "Total ink is not limited in the file: it is RGB, so the printer's own profile decides; black is RGB 0 0 0.",
        "Order: single-sided, full color, best quality, sRGB to your printer's profile, relative colorimetric intent.",
        "Switch off scaling, sharpening and all automatic color or photo enhancement; no lamination, no gloss.",
    ]


def _pages(pdf) -> Iterator[str]:
    sizes = [_size(page.mediabox) for page in pdf.pages]
    count = "1 page" if len(sizes) == 1 else f"{len(sizes)} pages"
    yield f"PDF {pdf.pdf_version}, {count} of {' and '.join(sorted(set(sizes)))} mm, true size (1:1)."
    for number, page in enumerate(pdf.pages, 1):
        boxes = [page.obj.get(f"/{name}Box") for name in ("Trim", "Bleed")]
        if None in boxes:
            yield f"PROBLEM: page {number} has no trim and bleed box."
        elif any([float(v) for v in box] != [float(v) for v in page.mediabox] for box in boxes):
            yield f"PROBLEM: trim and bleed box of page {number} are not the page: it would be cut elsewhere."
        if "/UserUnit" in page.obj and float(page.obj.UserUnit) != 1:
            yield f"PROBLEM: page {number} has a UserUnit, which many printers ignore."
    yield "Trim box and bleed box are given; no ink reaches the edge, so no bleed and no crop marks are needed."


def _scaling(pdf) -> str:
    wish = pdf.Root.get("/ViewerPreferences", {}).get("/PrintScaling")
    if wish == "/None":
        return "The file asks viewers not to scale it (PrintScaling None); still check that 100 % is set."
    return "PROBLEM: the file does not ask viewers to leave its size alone (PrintScaling None is missing)."


def _fonts(pdf) -> Iterator[str]:
    names: dict[str, bool] = {}
    for page in pdf.pages:
        for font in page.resources.get("/Font", {}).values():
            names[str(font.get("/BaseFont", "?")).lstrip("/").split("+")[-1]] = _embedded(font)
    loose = sorted(name for name, embedded in names.items() if not embedded)
    if loose:
        yield f"PROBLEM: fonts that are not embedded: {', '.join(loose)}."
    elif names:
        yield f"All fonts are embedded ({', '.join(sorted(names))})."


def _embedded(font) -> bool:
    inner = font.DescendantFonts[0] if "/DescendantFonts" in font else font
    descriptor = inner.get("/FontDescriptor", {})
    return any(f"/FontFile{kind}" in descriptor for kind in ("", "2", "3"))


def _images(pdf) -> Iterator[str]:
    for number, page in enumerate(pdf.pages, 1):
        resources = page.resources.get("/XObject", {})
        for name, (width_mm, height_mm) in _placed(page):
            image = resources.get(name)
            if image is None or image.get("/Subtype") != "/Image":
                continue
            ppi = min(int(image.Width) / width_mm, int(image.Height) / height_mm) * MM_PER_INCH
            yield (
                f"Page {number}: an image of {int(image.Width)} × {int(image.Height)} pixels on {width_mm:.1f} × "
                f"{height_mm:.1f} mm, {ppi:.0f} ppi; {_packing(image)}; {_color(image.get('/ColorSpace'))}; "
                "its pixels are meant as they are, so do not resample or sharpen."
            )


def _placed(page) -> Iterator[tuple[str, tuple[float, float]]]:
    """Every drawn XObject's name and its width and height in mm, from the matrices in force."""
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
            yield (
                str(operands[0]),
                ((matrix.a**2 + matrix.b**2) ** 0.5 * _MM, (matrix.c**2 + matrix.d**2) ** 0.5 * _MM),
            )


def _packing(image) -> str:
    filters = image.get("/Filter", [])
    names = {str(f) for f in (filters if _is_array(filters) else [filters])}
    return "lossless" if names <= _LOSSLESS else f"PROBLEM: lossy ({', '.join(sorted(names - _LOSSLESS))})"


def _color(space: Any) -> str:
    if space is None or not _is_array(space) or str(space[0]) != "/ICCBased":
        return "PROBLEM: no ICC profile"
    return f"ICC profile {_profile_name(space[1])}"


def _vector_color(pdf) -> str:
    spaces = [page.resources.get("/ColorSpace", {}).get("/DefaultRGB") for page in pdf.pages]
    if any(space is None for space in spaces):
        return "PROBLEM: words, markers and swatches are device RGB without a profile."
    names = sorted({_profile_name(space[1]) for space in spaces})
    return f"Words, markers and swatches are vector, RGB with the ICC profile {', '.join(names)} (DefaultRGB)."


def _profile_name(stream) -> str:
    from PIL import ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(stream.read_bytes()))
        return ImageCms.getProfileDescription(profile).strip()
    except (ImageCms.PyCMSError, OSError):
        return "PROBLEM: broken"


def _is_array(value: Any) -> bool:
    import pikepdf

    return isinstance(value, (list, pikepdf.Array))


def _size(box) -> str:
    x0, y0, x1, y1 = (float(v) for v in box)
    return f"{round((x1 - x0) * _MM, 1):g} × {round((y1 - y0) * _MM, 1):g}"
