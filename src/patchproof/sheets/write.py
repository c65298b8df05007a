"""Write SHEET.pdf and SHEET.json: both complete, or neither.

In: a piece with its design and promise, and a template. Out: two files with the same stem; the manifest is also
attached to the PDF, with the same bytes. Both are first written beside their places and then moved there, so that a
full disk or a crash leaves the old files.
Left out on purpose: asking before overwriting, which the command line does.
"""

from collections.abc import Sequence
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.output import write_atomically, write_files_atomically
from patchproof.sheets.content import SheetContent, page_manifest
from patchproof.sheets.layout import PageLayout
from patchproof.sheets.manifest import Manifest, dump_manifest
from patchproof.sheets.page import lay_out_page
from patchproof.sheets.pdf import ATTACHMENT, PdfPage, numbered_name, pages_pdf
from patchproof.sheets.piece import page_id
from patchproof.sheets.plan_page import PlanPage, lay_out_plan
from patchproof.sheets.rects import RectMm
from patchproof.sheets.template import AnyTemplate, Template


def write_sheet(
    pdf_path: str | Path,
    template: Template | None,
    content: SheetContent,
    plan: PlanPage | None = None,
    copies: int = 1,
) -> Manifest:
    """Write SHEET.pdf and SHEET.json beside it. `plan` becomes the last page; `copies` repeats the page with the piece,
    and is refused for a template with tiles, which has a page for each tile. Without a template only SHEET.json is.
    """
    if template is None:
        if Path(pdf_path).suffix != ".json":
            expected = "a file name that ends in .json, since this print has no page"
            raise Refused(expected, f'"{pdf_path}"', "name it PRINT.json, or a template for a page")
        size_mm = content.piece.size_mm
        manifest = content.manifest(PageLayout(size_mm), None, (0.0, 0.0, *size_mm))
        write_atomically(Path(pdf_path), dump_manifest(manifest))
        return manifest
    pdf_path = check_pdf_path(pdf_path)
    if template.tiles is None:
        page = lay_out_page(template, content)
        pages = [PdfPage(page, content.pictures(page.cuts_mm[0]))] * copies
        manifest = content.manifest(page, template, page.cuts_mm[0])
    elif copies > 1:
        raise Refused("one copy of a piece in tiles", f"{copies} copies", "print the file several times")
    else:
        from patchproof.sheets.tiles import tile_pages

        pages, manifest = tile_pages(template, template.tiles, content)
    if plan is not None:
        pages.append(lay_out_plan(plan, template, content.sheet_id))
        manifest = manifest.changed(plan_page=len(pages))
    save_sheets(pdf_path, pages, {pdf_path.with_suffix(".json"): manifest})
    return manifest


def write_page(pdf_path: str | Path, page: PageLayout, template: AnyTemplate, cut_mm: RectMm, kind: str) -> Manifest:
    """Write a page without a piece, and its manifest beside it, whose only setting is the template's table `kind`."""
    pdf_path = check_pdf_path(pdf_path)
    settings = {kind: getattr(template, kind).model_dump(mode="json")}
    manifest = page_manifest(page, template, cut_mm, sheet_id=page_id(template), kind=kind, settings=settings)
    save_sheets(pdf_path, [PdfPage(page)], {pdf_path.with_suffix(".json"): manifest})
    return manifest


def check_pdf_path(path: str | Path) -> Path:
    """Return the path; refused if it does not end in .pdf."""
    path = Path(path)
    if path.suffix.lower() != ".pdf":
        raise Refused("a file name that ends in .pdf", f'"{path}"', "name the sheet SHEET.pdf")
    return path


def manifest_paths(pdf_path: Path, designs: int) -> list[Path]:
    """Paths of the manifests: SHEET.json, or SHEET_1.json and so on for a page of several designs."""
    if designs < 2:
        return [pdf_path.with_suffix(".json")]
    return [pdf_path.with_name(numbered_name(f"{pdf_path.stem}.json", i)) for i in range(designs)]


def save_sheets(pdf_path: Path, pages: Sequence[PdfPage], manifests: dict[Path, Manifest]) -> None:
    """Write the PDF and its manifests, which are attached to it: one as sheet.json, several as sheet_1.json..."""
    texts, first = [dump_manifest(manifest) for manifest in manifests.values()], next(iter(manifests.values()))
    names = [ATTACHMENT] if len(texts) == 1 else [numbered_name(ATTACHMENT, i) for i in range(len(texts))]
    title = f"patchproof sheet {' '.join(m.sheet_id for m in manifests.values())} {first.kind}"
    pdf = pages_pdf(pages, title, dict(zip(names, texts, strict=True)))
    write_files_atomically({pdf_path: pdf} | dict(zip(manifests, map(str.encode, texts), strict=True)))
