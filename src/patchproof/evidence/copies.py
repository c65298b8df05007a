"""Photographs that are one and the same: files copied or saved again, and shots of a burst. They count once.

In: measured photographs and their sessions. Out: the same, all but the first of each kind rejected as "copy" with the
first one's name. Equal bytes are a copy wherever they lie. Other files are one where they are of one session and sheet,
light and place in the picture differ by no more than two shots of a hand-held camera do: a centimeter in half a meter,
a degree or two, an aim that is off by a hundredth of the picture, exposures that differ by a fourteenth of a stop.
Left out on purpose: pictures without a readable sheet that differ in their bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Remark
from patchproof.sheets.manifest import Rect

COPY_CODE = "copy"
# What two shots of one view differ by at most. Of 800 views drawn from the default ranges, in sessions of 40, none is
# taken for another (2 are with a SHAPE of 0.02).
SCALE, TILT, LIGHT = 0.02, 0.02, 0.05  # of pixels per mm, the tilt's cosine, the light of white paper
AIM = 0.01  # of the picture's longer side
SHAPE = 0.01  # of the design's longer side, by which its corners lie elsewhere about its middle


def reject_copies(photos: Sequence[MeasuredPhoto], session: Sequence[int], rect_mm: Rect) -> list[MeasuredPhoto]:
    """The photographs, of which all but the first of each kind are rejected; the design lies at `rect_mm`."""
    first_of: dict[str, PhotoEntry] = {}
    views: dict[int, list[tuple[np.ndarray, PhotoEntry]]] = {}
    kept = []
    for photo, number in zip(photos, session, strict=True):
        entry, view = photo.entry, _view(photo, rect_mm)
        same = None if entry.sha256 is None else first_of.get(entry.sha256)
        advice = "its bytes are those of {}, which counts once: leave it out"
        if same is None and view is not None:
            same = next((other for known, other in views.get(number, ()) if _alike(view, known)), None)
            advice = "it shows what {} shows, from there and in its light, and counts once: take another view"
        if same is None:
            first_of |= {} if entry.sha256 is None else {entry.sha256: entry}
            views.setdefault(number, []).extend([] if view is None else [(view, entry)])
        else:
            remark = Remark(code=COPY_CODE, advice=advice.format(same.file))
            photo = replace(photo, entry=entry.changed(status="rejected", remark=remark), counted=False)
        kept.append(photo)
    return kept


def _view(photo: MeasuredPhoto, rect_mm: Rect) -> np.ndarray | None:
    """Figures of pose and light that differ by 1 at most from one shot to the next, NaN for unknown ones; None of
    photographs that do not count, or that say too little.
    """
    geometry, size_px = photo.entry.geometry, photo.entry.photo_px
    if not photo.counted or geometry is None or photo.light is None or size_px is None:
        return None
    light = np.log(np.maximum(photo.light.paper, 1e-3)) / LIGHT
    figures = [np.log(geometry.px_per_mm / max(size_px)) / SCALE, np.cos(np.radians(geometry.tilt_deg)) / TILT, *light]
    corners = np.full((4, 2), np.nan)  # of rolled paper
    if geometry.homography_px_from_mm is not None:
        corners = apply_homography(np.array(geometry.homography_px_from_mm), rect_corners(rect_mm)) / max(size_px)
    middle = corners.mean(0)
    side = geometry.px_per_mm * max(rect_mm[2:]) / max(size_px)
    return np.array([*figures, *(middle / AIM), *((corners - middle) / side / SHAPE).ravel()])


def _alike(view: np.ndarray, other: np.ndarray) -> bool:
    unknown = np.isnan(view)
    return bool((unknown == np.isnan(other)).all() and (np.abs(view - other)[~unknown] <= 1).all())
