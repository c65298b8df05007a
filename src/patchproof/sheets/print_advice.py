"""Advice for printing and cutting a sheet, from its manifest.

In: a manifest. Out: sentences for whoever cuts the sheet, and for the print shop. What `pdf` writes into every file
(true size, boxes, fonts, profiles) is stated, and not read from it again: tests of the writer hold it.
"""

from collections.abc import Iterator

from patchproof.base.geometry import MM_PER_INCH
from patchproof.sheets.manifest import Manifest

SHOP_ADVICE = (
    "The PDF has its true size (1:1), a trim box and a bleed box; no ink reaches the edge, so no bleed and no crop "
    "marks are needed.",
    "The file asks viewers not to scale it (PrintScaling None); still check that 100 % is set.",
    "All fonts are embedded; texts, markers and swatches are vector graphics, RGB with an sRGB profile (DefaultRGB).",
    "Total ink is not limited in the file: it is RGB, so the printer's own profile decides; black is RGB 0 0 0.",
    "Order: single-sided, full color, best quality, sRGB to your printer's profile, relative colorimetric intent.",
    "Switch off scaling, sharpening and all automatic color or photo enhancement; no lamination, no gloss.",
)


def sheet_advice(manifest: Manifest) -> list[str]:
    """Sentences for whoever prints and cuts this sheet, from its manifest; `SHOP_ADVICE` adds those about any PDF."""
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
    else:
        (width_px, height_px), (width_mm, height_mm) = manifest.design.size_px, manifest.design.rect_mm[2:]
        ppi = min(width_px / width_mm, height_px / height_mm) * MM_PER_INCH
        lines.append(
            f"The design is an image of {width_px} × {height_px} pixels on {width_mm:.1f} × {height_mm:.1f} mm, "
            f"{ppi:.0f} ppi, lossless, in sRGB; its pixels must stay as they are, so do not resample or sharpen."
        )
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
