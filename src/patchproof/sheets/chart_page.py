"""Chart pages: a color chart alone, printed to learn what a printer does to colors.

In: a template without a place for a piece. Out: CHART.pdf and CHART.json. The sheet id is a hash of the template, so
equal templates give equal pages, and two charts can be told apart. `cut_mm` is the chart's own rectangle: nothing is
cut, but that is what photographs of the page are to show.
"""

from __future__ import annotations

from pathlib import Path

from patchproof.sheets.manifest import Manifest
from patchproof.sheets.page import lay_out_parts
from patchproof.sheets.pdf import Printed
from patchproof.sheets.piece import marker_ids, sheet_id
from patchproof.sheets.template import Template
from patchproof.sheets.write import page_manifest, pdf_name, qr_text, save_sheets

KIND = "chart"


def chart_sheet(template: Template, pdf_path: str | Path) -> Manifest:
    """Write the chart's page and its manifest beside it."""
    pdf_path = pdf_name(pdf_path)
    identity = sheet_id({"template": template.model_dump(mode="json")}, 0)
    ids = marker_ids(identity, "blank", len(template.marker.corners_mm))  # a chart has an id of its own, so no kind
    grid = template.chart
    words = {"sheet_id": identity, "kind": KIND, "swatches": str(grid.columns * grid.rows)}
    page = lay_out_parts(template, [], ids, qr_text(identity, KIND, None), words)
    pitch = grid.swatch_mm + grid.gap_mm
    width, height = (round(count * pitch - grid.gap_mm, 6) for count in (grid.columns, grid.rows))
    cut_mm = (*grid.corner_mm, width, height)
    manifest = page_manifest(page, template, cut_mm, identity, KIND, {KIND: grid.model_dump(mode="json")})
    save_sheets(pdf_path, [Printed(page)], {pdf_path.with_suffix(".json"): manifest})
    return manifest
