"""The content of the capture page as plain data: verdict so far, map of views, sessions, photographs with advice.

In: a collection of photographs. Out: JSON values. Every sentence about a photograph or the promise is the report's:
remarks' advice, the verdict's reason, the plan page's counts. On the map of views, cells are equal steps of azimuth and
of distance (1 over pixels per millimeter), and need photographs in proportion to their shares of the conditions.
Distance itself is not on it: only cameras of known focal length measure it, and a network does not see it.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.app.capture.album import CONTROLS
from patchproof.app.capture.collection import PhotoCollection
from patchproof.evidence.results import PhotoEntry
from patchproof.evidence.task import figures_of
from patchproof.evidence.verdict import PHOTOS_PER_SESSION
from patchproof.report.page import data_uri, jpeg
from patchproof.report.words import VERDICTS, benefit_sentence, headline_of
from patchproof.sheets.manifest import ConditionClaim

_LATEST_PHOTOS = 12  # that are listed with advice
_USUAL_SESSIONS = 4  # on the map, if no number of sessions would prove the promise
_ROWS, _MOST_COLUMNS = 3, 5
_LEAST_COLUMN_DEG = 12.0  # about the error of a person who aims a phone by hand


def state_of(collection: PhotoCollection, sessions: int | None) -> dict[str, Any]:
    """Everything that the page shows, except for single answers; `sessions` (None: 4) are planned on the map."""
    report = collection.report()
    summary, data, promise = report.summary, report.summary.model_dump(), collection.promise
    counts = {row["name"]: row for row in data["sessions"]}
    rows = [counts.get(name, {"name": name, "judged": 0, "recognized": 0}) for name in collection.album.sessions]
    photos, width_mm = collection.photos, collection.manifest.cut_mm[2]
    counted = [photo.entry for path, photo in photos.items() if photo.counted and collection.control_of(path) is None]
    wanted = PHOTOS_PER_SESSION * (sessions or _USUAL_SESSIONS)
    names = sorted(photos, key=lambda path: path.name)  # in the order of arrival
    return {
        "verdict": summary.verdict,
        "headline": VERDICTS[summary.verdict],
        "reason": summary.reason,
        "effect": f"{headline_of(data)}. {benefit_sentence(data)}",
        "photos": summary.photos,
        "judged": summary.judged,
        "sessions": rows,
        "each": PHOTOS_PER_SESSION,
        "plan": summary.next_step,
        "controls": [{"name": each.name, "photos": each.n, "recognized": each.recognized} for each in report.controls],
        "controls_known": [name for name in CONTROLS if name in promise.controls] or CONTROLS,
        "map": map_views(promise.conditions, counted, wanted, collection.side_px, width_mm),
        "latest": [answer_of(collection, path) for path in names[-_LATEST_PHOTOS:][::-1]],
    }


def answer_of(collection: PhotoCollection, path: Path, picture: np.ndarray | None = None) -> dict[str, Any]:
    """The answer to one measured photograph, with advice; `picture` (uint8 H×W×3) is included as a data URI."""
    photo, name = collection.photos[path], collection.promise.models[0].name
    entry = photo.entry
    prediction = entry.predictions.get(name) if photo.counted else None
    answer = "not counted" if prediction is None else "recognized" if prediction.recognized else "not recognized"
    return {
        "file": f"{path.parent.name}/{path.name}",
        "answer": answer,
        "tap": collection.wants_corners(path),
        "label": prediction and f"{prediction.label} {prediction.confidence:.0%}",
        "code": entry.code,
        "advice": "; ".join(filter(None, (entry.remark and entry.remark.advice, *entry.said))) or None,
        "view": _view_words(entry),
        "picture": None if picture is None else data_uri(jpeg(picture)),
    }


def _view_words(entry: PhotoEntry) -> str:
    """Describe the view by distance, side and tilt, as far as they were measured."""
    geometry, pose, parts = entry.geometry, entry.pose, []
    if pose is not None and pose.distance_mm is not None:
        parts.append(f"{pose.distance_mm / 1000:.2f} m")
    if pose is not None and pose.azimuth_deg is not None:
        parts.append(f"{abs(pose.azimuth_deg):.0f}° {'right' if pose.azimuth_deg > 0 else 'left'}")
    if geometry is not None and geometry.tilt_deg is not None:
        parts.append(f"tilt {geometry.tilt_deg:.0f}°")
    return ", ".join(parts)


def map_views(
    conditions: Sequence[ConditionClaim],
    entries: Sequence[PhotoEntry],
    wanted: int,
    side_px: float | None,
    piece_mm: float,
) -> dict[str, Any] | None:
    """Map counted photographs, of which `wanted` are needed in total; None if the conditions have no views.

    Columns run in degrees from left to right, rows from near to far (the share of a picture's shorter `side_px` that
    the piece takes, or else pixels per millimeter); `next` is the (row, column) that lacks the most photographs,
    `elsewhere` counts those whose view is unknown. Photographs beyond the edges, which the promise's margin allows,
    count in the outermost cells.
    """
    views = np.array([(c.azimuth_deg, c.px_per_mm) for c in conditions if c.azimuth_deg is not None and c.px_per_mm])
    if not len(views):
        return None
    (left, smallest), (right, largest) = views.min(0), views.max(0)
    columns = int(np.clip((right - left) // _LEAST_COLUMN_DEG, 1, _MOST_COLUMNS))
    azimuth_deg, distance = np.linspace(left, right, columns + 1), np.linspace(1 / largest, 1 / smallest, _ROWS + 1)

    def counts(points: np.ndarray) -> np.ndarray:
        inside = np.clip(1 / points[:, 1], *distance[[0, -1]]), np.clip(points[:, 0], left, right)
        return np.histogram2d(*inside, (distance, azimuth_deg))[0]

    figures = [figures_of(entry, side_px) for entry in entries]
    photo_views = [(each.get("azimuth_deg"), each.get("px_per_mm")) for each in figures]
    known_views = np.array([view for view in photo_views if None not in view]).reshape(-1, 2)
    photos, needed = counts(known_views).astype(int), np.rint(wanted * counts(views) / len(views)).astype(int)
    share, words = (1, "{:.1f}–{:.1f} px/mm") if side_px is None else (100 * piece_mm / side_px, "{:.0f}–{:.0f} %")
    return {
        "columns": [_azimuth_words(low, high) for low, high in pairwise(azimuth_deg)],
        "rows": [words.format(share * low, share * high) for high, low in pairwise(1 / distance)],
        "photos": photos.tolist(),
        "wanted": needed.tolist(),
        "elsewhere": len(photo_views) - len(known_views),
        "next": divmod(int((needed - photos).argmax()), columns) if (needed > photos).any() else None,
        "of_picture": side_px is not None,
    }


def _azimuth_words(low: float, high: float) -> str:
    """Describe a range of azimuths, as seen by somebody who looks at the piece."""
    if low < 0 < high:
        return f"{-low:.0f}° left to {high:.0f}° right"
    near, far = sorted((abs(low), abs(high)))
    return f"{near:.0f}–{far:.0f}° {'left' if low < 0 else 'right'}"
