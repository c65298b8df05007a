"""Reject photographs that repeat another one: copied or re-saved files, and shots of a burst. They count once.

In: measured photographs and their sessions. Out: all of them, each repetition rejected as "copy" with the first one's
name. Files with equal bytes are copies in any session. Files of one session are copies if light and the sheet's place
in the picture differ by no more than between two shots of a hand-held camera: a centimeter in half a meter, a degree
or two, an aim that is off by a hundredth of the picture, exposures that differ by a fourteenth of a stop.
Left out on purpose: pictures without a readable sheet that differ in their bytes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Remark
from patchproof.sheets.manifest import Rect

COPY_CODE = "copy"
# Largest differences between two shots of one view. Of 800 views drawn from the default ranges, in sessions of 40, none
# is taken for another (2 are with a shape tolerance of 0.02).
SCALE_TOLERANCE, TILT_TOLERANCE = 0.02, 0.02  # relative of pixels per mm, absolute of the tilt's cosine
LIGHT_TOLERANCE = 0.05  # relative, of the light of white paper
AIM_TOLERANCE = 0.01  # of the picture's longer side
SHAPE_TOLERANCE = 0.01  # of the design's longer side: offset of its corners about its middle
_FIGURES = 16  # of a view: session, scale, tilt, light in three colors, the middle's place, the shape of four corners


def reject_copies(photos: Sequence[MeasuredPhoto], session: Sequence[int], rect_mm: Rect) -> list[MeasuredPhoto]:
    """Reject every photograph that repeats an earlier one; the design lies at `rect_mm` of the page."""
    first_by_sha256: dict[str, PhotoEntry] = {}
    rows_by_cell: dict[tuple[float, ...], list[int]] = {}  # so that a view is compared with those near it alone
    originals, results = np.empty((len(photos), _FIGURES)), []
    for row, (photo, number) in enumerate(zip(photos, session, strict=True)):
        entry, view = photo.entry, _view(photo, number, rect_mm)
        first = None if entry.sha256 is None else first_by_sha256.get(entry.sha256)
        advice = "its bytes are those of {}, which counts once: leave it out"
        if first is None and view is not None:
            own_cell, *cells = _cells_near(view)
            rows = sorted(row for cell in (own_cell, *cells) for row in rows_by_cell.get(cell, ()))
            same = _find_same_view(view, originals[rows])
            first = None if same is None else photos[rows[same]].entry
            advice = "it shows what {} shows, from there and in its light, and counts once: take another view"
            if first is None:
                originals[row] = view
                rows_by_cell.setdefault(own_cell, []).append(row)
        if first is None:
            first_by_sha256 |= {} if entry.sha256 is None else {entry.sha256: entry}
        else:
            remark = Remark(code=COPY_CODE, advice=advice.format(first.file))
            photo = replace(photo, entry=entry.changed(status="rejected", remark=remark), counted=False)
        results.append(photo)
    return results


def _view(photo: MeasuredPhoto, session: int, rect_mm: Rect) -> np.ndarray | None:
    """Describe session, pose and light by `_FIGURES` in units of their tolerance (NaN: unknown); None for a photograph
    that is not counted, or whose geometry or light is unknown.
    """
    geometry, size_px = photo.entry.geometry, photo.entry.photo_px
    if not photo.counted or geometry is None or photo.light is None or size_px is None:
        return None
    light = np.log(np.maximum(photo.light.paper, 1e-3)) / LIGHT_TOLERANCE
    scale = np.log(geometry.px_per_mm / max(size_px)) / SCALE_TOLERANCE
    tilt = np.nan if geometry.tilt_deg is None else np.cos(np.radians(geometry.tilt_deg)) / TILT_TOLERANCE
    corners = np.full((4, 2), np.nan)  # unknown on rolled paper
    if geometry.homography_px_from_mm is not None:
        corners = apply_homography(np.array(geometry.homography_px_from_mm), rect_corners(rect_mm)) / max(size_px)
    middle = corners.mean(0)
    side = geometry.px_per_mm * max(rect_mm[2:]) / max(size_px)
    shape = (corners - middle) / side / SHAPE_TOLERANCE
    return np.array([2 * session, scale, tilt, *light, *(middle / AIM_TOLERANCE), *shape.ravel()])


def _cells_near(view: np.ndarray) -> Iterator[tuple[float, ...]]:
    """The cells of session, scale and the middle's place where views like this one may lie; its own is the first."""
    own = np.floor(np.nan_to_num(view[[1, 6, 7]]) / 1.01)  # a cell is wider than a tolerance
    return ((float(view[0]), *(own + offset).tolist()) for offset in product((0, -1, 1), repeat=3))


def _find_same_view(view: np.ndarray, others: np.ndarray) -> int | None:
    """The first row of `others` that knows the same figures, none of which differs by more than its tolerance."""
    unknown = np.isnan(view)
    alike = (np.isnan(others) == unknown) & ((np.abs(others - view) <= 1) | unknown)
    rows = np.flatnonzero(alike.all(1))
    return int(rows[0]) if len(rows) else None
