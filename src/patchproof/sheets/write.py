"""SHEET.pdf and SHEET.json: both complete, or neither.

In: a piece, a template, the design's pixels, and the promise. Out: two files with the same stem, and the manifest, of
which the PDF carries the same bytes as an attachment. They are written beside their places first and moved there
last, so that a full disk or a crash leaves what was there before. `check_sheet` says in plain sentences what whoever
prints and cuts it needs to know.
Left out on purpose: asking before overwriting, which is the command line's business.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.output import write_together
from patchproof.sheets.layout import PageLayout
from patchproof.sheets.manifest import Design, Manifest, Promise, Swatch, design_sha256, dump_manifest, png_base64
from patchproof.sheets.page import lay_out_page
from patchproof.sheets.pdf import ATTACHMENT, Printed, numbered, pages_pdf
from patchproof.sheets.piece import Piece, printed
from patchproof.sheets.plan_page import PlanPage, lay_out_plan
from patchproof.sheets.rects import RectMm, holds
from patchproof.sheets.swatches import FRAME_COLORS
from patchproof.sheets.template import BoardTemplate, Template
from patchproof.sheets.tile_pages import FIRST_TILE_PAGE, tile_pages
from patchproof.strict import Refused


def write_sheet(
    pdf_path: str | Path,
    *,
    template: Template,
    piece: Piece,
    sheet_id: str,
    kind: str,
    design_srgb8: np.ndarray | None,
    promise: Promise | None,
    settings: dict[str, Any],
    plan: PlanPage | None = None,
    copies: int = 1,
) -> Manifest:
    """Write SHEET.pdf and SHEET.json beside it; `design_srgb8` is uint8 H×W×3, or None for white paper.

    A template with tiles makes a page for each. `plan` becomes the last page; `copies` repeats the page with the piece.
    """
    pdf_path = pdf_name(pdf_path)
    if design_srgb8 is not None:
        check_pixels(design_srgb8)
    code = qr_text(sheet_id, kind, design_srgb8)
    if template.tiles is None:
        page = lay_out_page(template, piece, sheet_id, kind, code)
        design = None if design_srgb8 is None else printed_design(design_srgb8, page.designs_mm[0])
        manifest = page_manifest(page, template, page.cuts_mm[0], sheet_id, kind, settings, design, promise)
        pages = [Printed(page, () if design_srgb8 is None else ((page.designs_mm[0], design_srgb8),))] * copies
    else:
        if copies > 1:
            raise Refused("one copy of a piece in tiles", f"{copies}", "print the file more than once")
        tiled = tile_pages(template, template.tiles, piece, sheet_id, kind, code, design_srgb8)
        design = None if design_srgb8 is None else printed_design(design_srgb8, tiled.design_mm, FIRST_TILE_PAGE)
        pages = list(tiled.pages)
        manifest = page_manifest(
            pages[0].layout, template, tiled.cut_mm, sheet_id, kind, settings, design, promise
        ).changed(markers=tiled.markers, chart=tiled.chart, tiles=tiled.tiles)
    if plan is not None:
        pages.append(lay_out_plan(plan, template, sheet_id))
        manifest = manifest.changed(plan_page=len(pages))
    save_sheets(pdf_path, pages, {pdf_path.with_suffix(".json"): manifest})
    return manifest


def pdf_name(path: str | Path) -> Path:
    """The path; refused where it does not end in .pdf."""
    path = Path(path)
    if path.suffix.lower() != ".pdf":
        raise Refused("a file name that ends in .pdf", f'"{path}"', "name the sheet SHEET.pdf")
    return path


def manifest_paths(pdf_path: Path, designs: int) -> list[Path]:
    """Where the manifests lie: SHEET.json, or SHEET_1.json and so on beside a page of several designs."""
    if designs < 2:
        return [pdf_path.with_suffix(".json")]
    return [pdf_path.with_name(numbered(f"{pdf_path.stem}.json", i)) for i in range(designs)]


def save_sheets(pdf_path: Path, pages: Sequence[Printed], manifests: dict[Path, Manifest]) -> None:
    """Write the PDF and its manifests, which it carries too: one as sheet.json, several as sheet_1.json..."""
    texts = {path: dump_manifest(manifest) for path, manifest in manifests.items()}
    first = next(iter(manifests.values()))
    names = [ATTACHMENT] if len(texts) == 1 else [numbered(ATTACHMENT, i) for i in range(len(texts))]
    title = f"patchproof sheet {' '.join(m.sheet_id for m in manifests.values())} {first.kind}"
    pdf = pages_pdf(pages, title, dict(zip(names, texts.values(), strict=True)))
    write_together({pdf_path: pdf} | {path: text.encode() for path, text in texts.items()})


def qr_text(sheet_id: str, kind: str, design_srgb8: np.ndarray | None) -> str:
    """What the QR code says: the sheet's id and 16 digits of the design's SHA-256 (the kind where there is none)."""
    return f"patchproof:{sheet_id}:{kind if design_srgb8 is None else design_sha256(design_srgb8)[:16]}"


def check_sheet(manifest: Manifest) -> list[str]:
    """What whoever prints this sheet should know of what is on it, in sentences; `shop.shop_lines` reads the PDF."""
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
    lines += [*_cutting(manifest)]
    if manifest.plan_page is not None:
        lines.append(
            f"Page {manifest.plan_page} is for people, on any paper: where the piece goes and how to photograph it."
        )
    if manifest.design is None:
        lines.append("The piece carries no design: its middle stays white paper.")
    frames = {tile.page: tile.cut_mm for tile in manifest.tiles} or {1: manifest.cut_mm}
    inside = sum(s.page in frames and holds(frames[s.page], s.rect_mm) for s in manifest.chart)
    if inside < len(FRAME_COLORS):
        lines.append(
            f"The frame has room for {inside} of {len(FRAME_COLORS)} swatches, so color on it is measured less well."
        )
    return lines


def _cutting(manifest: Manifest) -> Iterator[str]:
    """What is cut out of which page."""
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


def printed_design(design: np.ndarray, rect_mm: RectMm, page: int = 1) -> Design:
    """The design as the manifest carries it."""
    return Design(
        sha256=design_sha256(design),
        rect_mm=rect_mm,
        size_px=(design.shape[1], design.shape[0]),
        page=page,
        png=png_base64(design),
    )


def page_manifest(
    page: PageLayout,
    template: Template | BoardTemplate,
    cut_mm: RectMm,
    sheet_id: str,
    kind: str,
    settings: dict[str, Any],
    design: Design | None = None,
    promise: Promise | None = None,
) -> Manifest:
    """The manifest of a sheet's one page."""
    return Manifest(
        sheet_id=sheet_id,
        kind=kind,
        page_mm=page.page_mm,
        design=design,
        markers=tuple(printed(m) for m in page.markers),
        chart=tuple(Swatch(rect_mm=rect, srgb=srgb, page=1) for rect, srgb in page.swatches),
        cut_mm=cut_mm,
        ruler_mm=(template.ruler.length_mm, template.ruler.length_mm),
        promise=promise,
        settings=settings,
    )


def check_pixels(design: np.ndarray) -> None:
    """Refuse what is no picture of uint8 H×W×3."""
    if design.dtype != np.uint8 or design.ndim != 3 or design.shape[2] != 3 or design.size == 0:
        raise Refused("a design of uint8 H×W×3 pixels", f"{design.dtype} {design.shape}", "convert it to 8-bit RGB")


def _nearest_ink_mm(manifest: Manifest) -> float:
    """From the page's edge to the nearest marker, swatch or cut line."""
    width, height = manifest.page_mm
    rects = [tile.cut_mm for tile in manifest.tiles] or [manifest.cut_mm]
    rects = [*rects, *(swatch.rect_mm for swatch in manifest.chart)]
    points = [point for marker in manifest.markers for point in marker.corners_mm]
    points += [(x + dx, y + dy) for x, y, w, h in rects for dx, dy in ((0, 0), (w, h))]
    return min(min(x, y, width - x, height - y) for x, y in points)
