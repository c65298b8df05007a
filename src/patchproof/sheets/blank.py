"""Blank sheets: a page whose piece carries markers and swatches but no design, printed before there is a scene.

In: a template with a [blank] table. Out: BLANK.pdf and BLANK.json. Photographs of the object with this piece on it show
where a design of the same size would lie and what light falls on it; that is all that a photographed scene needs. The
sheet id is a hash of the template, so equal templates give equal pages. The manifest carries no design, but its cut
line and markers say all about the piece: `blank_piece_mm` reads its two sizes back.
"""

from __future__ import annotations

from pathlib import Path

from patchproof.sheets.manifest import Manifest
from patchproof.sheets.piece import frame_mm, lay_out_piece, sheet_id
from patchproof.sheets.template import load_template, template_names
from patchproof.sheets.write import write_sheet
from patchproof.strict import Refused


def blank_sheet(template: str | Path, pdf_path: str | Path) -> Manifest:
    """Write the blank page of a template (a shipped one's name, or a TOML file) and its manifest beside it."""
    page = load_template(template)
    if page.blank is None:
        raise Refused(
            "a template with a [blank] table for a page without a design",
            f"{template}",
            f"use one of: {', '.join(template_names('blank'))}, or name the run whose design belongs on the page",
        )
    identity = sheet_id({"template": page.model_dump(mode="json")}, 0)
    return write_sheet(
        pdf_path,
        template=page,
        piece=lay_out_piece(page.blank.design_mm, page.blank.marker_mm, identity, "blank"),
        sheet_id=identity,
        kind="blank",
        design_srgb8=None,
        promise=None,
        settings={"blank": page.blank.model_dump(mode="json")},
    )


def blank_piece_mm(manifest: Manifest) -> tuple[tuple[float, float], float]:
    """(design's width and height, marker size) of a blank sheet, from its cut line and the first marker in it."""
    if manifest.kind != "blank":
        raise Refused(
            "the manifest of a blank sheet", f'one of kind "{manifest.kind}"', "name the JSON beside BLANK.pdf"
        )
    (x0, _), (x1, _) = manifest.markers[0].corners_mm[:2]  # the piece's markers come first
    marker_mm = round(x1 - x0, 4)
    width, height = (round(side - 2 * frame_mm(marker_mm), 4) for side in manifest.cut_mm[2:])
    return (width, height), marker_mm
