"""Printers drawn from a seed, their charts on a page, and what a camera shows of their colors.

Printers are simulated inkjets and the packaged profiles, each of which never is its own prior.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from inkjets import DRIVERS, draw_inkjet
from patchproof.base.color import codes_from_srgb, linear_from_srgb
from patchproof.calibrate.chart import known_printers
from patchproof.reprints.page_photos import PX_PER_MM, PrintFunction, page_light
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.markers import DICTIONARY, marker_cells
from patchproof.sheets.page import chart_colors
from patchproof.sheets.piece import hash_order, manifest_marker, square_marker

PAGE_MM = (210.0, 148.0)
MARKER_MM, _MARKERS_MM = 14.0, ((8.0, 8.0), (188.0, 8.0), (188.0, 126.0), (8.0, 126.0))
_CHART_MM = (30.0, 34.0, 150.0, 84.0)
_GAP_MM = 0.4


def draw_printer(seed: int) -> tuple[str, PrintFunction, dict]:
    """(kind, print function, priors that a calibration may use): the priors never hold the printer itself."""
    priors, kinds = known_printers(), len(DRIVERS) + 1
    if seed % kinds < len(DRIVERS):
        inkjet = draw_inkjet(len(DRIVERS) * (seed // kinds) + seed % kinds)
        return inkjet.driver, inkjet, priors
    name = ("coated", "uncoated")[seed // kinds % 2]
    profile = priors.pop(name)
    return "the other profile", lambda colors: linear_from_srgb(profile(colors)), priors


def chart_manifest(count: int) -> Manifest:
    """The manifest of a page with `count` swatches in the middle, colored and ordered like those of printed sheets."""
    x, y, width, height = _CHART_MM
    columns = math.ceil(math.sqrt(count * width / height))
    side = min(width / columns, height / math.ceil(count / columns))
    cells = [(x + side * (i % columns), y + side * (i // columns)) for i in range(count)]
    colors, order = chart_colors(count), hash_order(f"photographed {count}", count)
    swatches = [
        {"rect_mm": (*cell, side - _GAP_MM, side - _GAP_MM), "srgb": colors[index], "page": 1}
        for cell, index in zip(cells, order, strict=True)
    ]
    markers = [manifest_marker(square_marker(7 + i, corner, MARKER_MM)) for i, corner in enumerate(_MARKERS_MM)]
    head = {
        "version": 2,
        "sheet_id": "CHART00000",
        "kind": "blank",
        "page_mm": PAGE_MM,
        "design": None,
        "promise": None,
    }
    rest = {"cut_mm": (100.0, 6.0, 1.0, 1.0), "ruler_mm": (100.0, 100.0), "settings": {}}
    return Manifest.model_validate(head | rest | {"markers": markers, "chart": swatches})


def printed_page(manifest: Manifest, shows: PrintFunction) -> np.ndarray:
    """The printed page as light H×W×3 at `PX_PER_MM`, with lines of text beside the chart as on sheets."""
    width, height = (round(side * PX_PER_MM) for side in manifest.page_mm)
    page = np.full((height, width, 3), 255, np.uint8)
    for marker, code in zip(manifest.markers, marker_cells(DICTIONARY, [m.id for m in manifest.markers]), strict=True):
        side = round(MARKER_MM * PX_PER_MM)
        picture = 255 * cv2.resize(code, (side, side), interpolation=0)
        _fill(page, (*marker.corners_mm[0], MARKER_MM, MARKER_MM), picture)
    for line, y_mm in enumerate((14, 20, 26, 124, 131, 138)):
        position = (30 * PX_PER_MM, y_mm * PX_PER_MM)
        cv2.putText(page, f"{line} what stands beside a chart is not white paper", position, 0, 0.9, (0, 0, 0), 2)
    for swatch in manifest.chart:
        _fill(page, swatch.rect_mm, codes_from_srgb(np.array(swatch.srgb)))
    return page_light(page, shows)


def _fill(page: np.ndarray, rect_mm, value: np.ndarray) -> None:
    x, y, w, h = (round(v * PX_PER_MM) for v in rect_mm)
    page[y : y + h, x : x + w] = value[..., None] if value.ndim == 2 else value
