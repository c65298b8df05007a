"""Write SHEET.pdf and SHEET.json: both complete, or neither.

In: a piece with its design and promise, or several, and a template. Out: files with the same stem; a manifest is also
attached to the PDF, with the same bytes. All are first written beside their places and then moved there, so that a full
disk or a crash leaves the old files. A page of several designs has SHEET_1.json, SHEET_2.json... in their order, an id
of its own and one QR code for all designs, since a code that lists three or more is too fine to be read at 150 dpi.
Pieces keep the marker ids with which they were promised, of 1000 ordered by hash, so two sheets may share one; the
page's own markers avoid all of them. A design's manifest lists the other markers on the page, too, if their ids are
unique on it, so that a photograph of the uncut page can be recognized. Left out on purpose: asking before overwriting,
which the command line does.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.output import write_atomically, write_files_atomically
from patchproof.sheets.content import KEEP_MARKERS, SheetContent, page_manifest, piece_words
from patchproof.sheets.layout import PageLayout
from patchproof.sheets.manifest import Manifest, design_sha256, dump_manifest
from patchproof.sheets.page import lay_out_page, lay_out_parts, piece_name, place_pieces
from patchproof.sheets.pdf import ATTACHMENT, PdfPage, numbered_name, pages_pdf
from patchproof.sheets.piece import hash_order, move_marker, page_id, sheet_id
from patchproof.sheets.plan_page import PlanPage, lay_out_plan
from patchproof.sheets.rects import RectMm, size_text
from patchproof.sheets.template import AnyTemplate, Template


def write_sheet(
    pdf_path: str | Path,
    template: Template | None,
    content: SheetContent,
    plan: PlanPage | None = None,
    copies: int = 1,
) -> Manifest:
    """Write SHEET.pdf and SHEET.json beside it, without a template only SHEET.json. `plan` becomes the last page;
    `copies` repeats the page with the piece, and is refused for a template with tiles.
    """
    if template is None:
        if Path(pdf_path).suffix != ".json":
            expected = "a file name that ends in .json, since this print has no page"
            raise Refused(expected, f'"{pdf_path}"', "name it PRINT.json, or a template for a page")
        if copies > 1:
            raise Refused("a page to repeat", "a print without one", "leave copies out")
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


def write_several(
    pdf_path: str | Path, template: Template, designs: Sequence[SheetContent], plans: Sequence[PlanPage | None] = ()
) -> list[Manifest]:
    """Write a page with at least two designs and a manifest for each; `plans`, in the order of the designs, become
    further pages. Refused if two designs belong to the same sheet.
    """
    pdf_path = check_pdf_path(pdf_path)
    if template.tiles is not None:
        raise Refused("a template of one page for several designs", "one with tiles", "make a sheet of each")
    repeated = [key for key, count in Counter((d.sheet_id, d.kind) for d in designs).items() if count > 1]
    if repeated:
        raise Refused("designs of different runs", f"sheet {repeated[0][0]} twice", "use --copies to repeat a design")
    pieces = place_pieces(template, [design.piece for design in designs])
    identity = sheet_id({"sheets": [[design.sheet_id, design.kind] for design in designs]}, 0)
    hashes = "".join(design_sha256(each.design_srgb8) for each in designs if each.design_srgb8 is not None)
    code = f"patchproof:{identity}:{hashlib.sha256(hashes.encode()).hexdigest()[:16]}"
    labels = [piece_words(design, pieces[i][1], piece_name(i)) for i, design in enumerate(designs)]
    sizes = " and ".join(sorted({size_text(design.piece.size_mm) for design in designs}))
    fix = "Put each piece on its object as its own plan page shows"
    used = {marker.id for design in designs for marker in design.piece.markers}
    words = {"sheet_id": identity, "kind": f"{len(designs)} designs", "design": sizes, "piece": sizes, "fix": fix}
    words["keep"] = KEEP_MARKERS if used else ""
    free = (i for i in hash_order(" ".join(design.sheet_id for design in designs), 1000) if i not in used)
    page_ids = list(islice(free, len(template.marker.corners_mm))) if used else []
    page = lay_out_parts(template, pieces, page_ids, code, words, labels)
    cuts = zip(designs, page.cuts_mm, strict=True)
    manifests = [_manifest(template, page, design, cut_mm).changed(page_code=code) for design, cut_mm in cuts]
    pages = [PdfPage(page, tuple(chain(*map(SheetContent.pictures, designs, page.cuts_mm))))]
    for i, plan in enumerate(plans):
        if plan is not None:
            pages.append(lay_out_plan(plan, template, designs[i].sheet_id))
            manifests[i] = manifests[i].changed(plan_page=len(pages))
    save_sheets(pdf_path, pages, dict(zip(manifest_paths(pdf_path, len(designs)), manifests, strict=True)))
    return manifests


def _manifest(template: Template, page: PageLayout, design: SheetContent, cut_mm: RectMm) -> Manifest:
    """One design's manifest: the markers of its piece, then all others on the page whose id is unique."""
    piece_markers = [move_marker(marker, cut_mm[:2]) for marker in design.piece.markers]
    counts = Counter(marker.id for marker in page.markers)
    others = [m for m in page.markers if piece_markers and counts[m.id] == 1 and m not in piece_markers]
    return design.manifest(replace(page, markers=(*piece_markers, *others)), template, cut_mm)


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
