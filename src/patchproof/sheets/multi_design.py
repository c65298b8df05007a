"""Write a page with several designs, each with its own piece, markers and manifest.

In: the contents that `write_sheet` takes, one for each design. Out: SHEET.pdf and SHEET_1.json, SHEET_2.json... in the
order of the designs, all of them attached to the PDF, in which each design's plan follows the page. The page has an id
of its own and one QR code for all designs: a code that lists three or more is too fine to be read at 150 dpi.
Pieces keep the marker ids with which they were promised. These are 1000 ids ordered by hash, so two sheets may share
one; the page's own markers avoid all of them. A design's manifest lists the other designs' markers with those of the
page if their id is unique on it, so that a photograph of the uncut page can be recognized.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.sheets.content import SheetContent, piece_words
from patchproof.sheets.layout import PageLayout
from patchproof.sheets.manifest import Manifest, design_sha256
from patchproof.sheets.page import lay_out_parts, piece_name, place_pieces
from patchproof.sheets.pdf import PdfPage
from patchproof.sheets.piece import hash_order, move_marker, sheet_id
from patchproof.sheets.plan_page import PlanPage, lay_out_plan
from patchproof.sheets.rects import RectMm, size_text
from patchproof.sheets.template import Template
from patchproof.sheets.write import check_pdf_path, manifest_paths, save_sheets


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
    if len(designs) < 2:
        raise Refused("several designs", f"{len(designs)}", "use write_sheet for one")
    if repeated:
        raise Refused("designs of different runs", f"sheet {repeated[0][0]} twice", "use --copies to repeat a design")
    pieces = place_pieces(template, [design.piece for design in designs])
    identity = sheet_id({"sheets": [[design.sheet_id, design.kind] for design in designs]}, 0)
    hashes = "".join(design_sha256(each.design_srgb8) for each in designs if each.design_srgb8 is not None)
    code = f"patchproof:{identity}:{hashlib.sha256(hashes.encode()).hexdigest()[:16]}"
    labels = [piece_words(design, pieces[i][1], piece_name(i)) for i, design in enumerate(designs)]
    sizes = " and ".join(sorted({size_text(design.piece.size_mm) for design in designs}))
    fix = "Put each piece on its object as its own plan page shows"
    words = {"sheet_id": identity, "kind": f"{len(designs)} designs", "design": sizes, "piece": sizes, "fix": fix}
    used = {marker.id for design in designs for marker in design.piece.markers}
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
    paths = manifest_paths(pdf_path, len(designs))
    save_sheets(pdf_path, pages, dict(zip(paths, manifests, strict=True)))
    return manifests


def _manifest(template: Template, page: PageLayout, design: SheetContent, cut_mm: RectMm) -> Manifest:
    """One design's manifest: the markers of its piece, then all others on the page whose id is unique."""
    piece_markers = [move_marker(marker, cut_mm[:2]) for marker in design.piece.markers]
    counts = Counter(marker.id for marker in page.markers)
    others = [marker for marker in page.markers if counts[marker.id] == 1 and marker not in piece_markers]
    others = others if piece_markers else []
    design_page = replace(page, markers=(*piece_markers, *others))
    return design.manifest(design_page, template, cut_mm)
