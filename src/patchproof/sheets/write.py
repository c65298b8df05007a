"""SHEET.pdf and SHEET.json: both complete, or neither.

In: a piece with its design and promise, and a template. Out: two files with the same stem, and the manifest, of
which the PDF carries the same bytes as an attachment. They are written beside their places first and moved there
last, so that a full disk or a crash leaves what was there before. `check_sheet` says in plain sentences what whoever
prints and cuts it needs to know.
Left out on purpose: asking before overwriting, which is the command line's business.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from patchproof.base.output import write_together
from patchproof.base.strict import Refused, Strict
from patchproof.sheets.content import PrintedPiece, page_manifest
from patchproof.sheets.layout import PageLayout
from patchproof.sheets.manifest import Manifest, dump_manifest
from patchproof.sheets.page import lay_out_page
from patchproof.sheets.pdf import ATTACHMENT, Printed, numbered, pages_pdf
from patchproof.sheets.piece import page_id
from patchproof.sheets.plan_page import PlanPage, lay_out_plan
from patchproof.sheets.rects import RectMm
from patchproof.sheets.template import BoardTemplate, Template
from patchproof.sheets.tile_pages import tile_pages


def write_sheet(
    pdf_path: str | Path, template: Template, content: PrintedPiece, plan: PlanPage | None = None, copies: int = 1
) -> Manifest:
    """Write SHEET.pdf and SHEET.json beside it.

    A template with tiles makes a page for each. `plan` becomes the last page; `copies` repeats the page with the piece.
    """
    pdf_path = pdf_name(pdf_path)
    if template.tiles is None:
        page = lay_out_page(template, content)
        pages = [Printed(page, content.pictures(page.cuts_mm[0]))] * copies
        manifest = content.manifest(page, template, page.cuts_mm[0])
    else:
        if copies > 1:
            raise Refused("one copy of a piece in tiles", f"{copies}", "print the file more than once")
        pages, manifest = tile_pages(template, template.tiles, content)
    if plan is not None:
        pages.append(lay_out_plan(plan, template, content.sheet_id))
        manifest = manifest.changed(plan_page=len(pages))
    save_sheets(pdf_path, pages, {pdf_path.with_suffix(".json"): manifest})
    return manifest


def write_page(
    pdf_path: str | Path, page: PageLayout, template: Template | BoardTemplate, cut_mm: RectMm, kind: str, grid: Strict
) -> Manifest:
    """Write a page without a piece, and its manifest beside it, in which `grid` is kept under the page's kind."""
    pdf_path = pdf_name(pdf_path)
    settings = {kind: grid.model_dump(mode="json")}
    manifest = page_manifest(page, template, cut_mm, page_id(template), kind, settings)
    save_sheets(pdf_path, [Printed(page)], {pdf_path.with_suffix(".json"): manifest})
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
    lines += _cutting(manifest)
    if manifest.plan_page is not None:
        piece = "the piece" if manifest.page_code is None else f"the piece of sheet {manifest.sheet_id}"
        lines.append(
            f"Page {manifest.plan_page} is for people, on any paper: where {piece} goes and how to photograph it."
        )
    if manifest.design is None:
        lines.append("The piece carries no design: between its markers it stays white paper.")
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


def _nearest_ink_mm(manifest: Manifest) -> float:
    """From the page's edge to the nearest marker, swatch or cut line."""
    width, height = manifest.page_mm
    rects = [tile.cut_mm for tile in manifest.tiles] or [manifest.cut_mm]
    rects = [*rects, *(swatch.rect_mm for swatch in manifest.chart)]
    points = [point for marker in manifest.markers for point in marker.corners_mm]
    points += [(x + dx, y + dy) for x, y, w, h in rects for dx, dy in ((0, 0), (w, h))]
    return min(min(x, y, width - x, height - y) for x, y in points)
