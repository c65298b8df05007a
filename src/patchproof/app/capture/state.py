"""The content of the capture page as plain data: verdict so far, map of views, sessions, photographs with advice.

In: a collection of photographs. Out: JSON values. Every sentence about a photograph or the promise is the report's:
remarks' advice, the verdict's reason, the plan page's counts.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.app.capture.album import CONTROLS
from patchproof.app.capture.collection import PhotoCollection
from patchproof.app.capture.view_map import map_views
from patchproof.base.output import image_bytes
from patchproof.evidence.results import PhotoEntry
from patchproof.evidence.verdict import PHOTOS_PER_SESSION
from patchproof.report.images import data_uri
from patchproof.report.words import VERDICTS, benefit_sentence, headline_of

_LATEST_PHOTOS = 12  # that are listed with advice
_USUAL_SESSIONS = 4  # on the map, if no number of sessions would prove the promise
_PREVIEW_OPTIONS = {"quality": 80}


def state_of(collection: PhotoCollection, sessions: int | None) -> dict[str, Any]:
    """Everything that the page shows, except for single answers; `sessions` (None: 4) are planned on the map."""
    report = collection.report()
    summary, data, promise = report.summary, report.summary.model_dump(), collection.manifest.promise
    counts = {row["name"]: row for row in data["sessions"]}
    rows = [counts.get(name, {"name": name, "judged": 0, "recognized": 0}) for name in collection.album.sessions]
    promised = promise.controls if promise is not None else ()
    names = sorted(collection.photos, key=lambda path: path.name)  # in the order of arrival
    return {
        "verdict": summary.verdict,
        "headline": VERDICTS[summary.verdict],
        "reason": summary.reason,
        "effect": f"{headline_of(data)}. {benefit_sentence(data)}",
        "photos": summary.photos,
        "judged": summary.judged,
        "recognized": sum(row["recognized"] for row in rows),
        "interval": summary.interval,
        "prediction_interval": summary.prediction_interval,
        "sessions": rows,
        "each": PHOTOS_PER_SESSION,
        "plan": summary.next_step,
        "controls": [{"name": each.name, "photos": each.n, "recognized": each.recognized} for each in report.controls],
        "controls_known": [name for name in CONTROLS if name in promised] or CONTROLS,
        "map": _map(collection, PHOTOS_PER_SESSION * (sessions or _USUAL_SESSIONS)),
        "latest": [answer_of(collection, path) for path in names[-_LATEST_PHOTOS:][::-1]],
    }


def answer_of(collection: PhotoCollection, path: Path, picture: np.ndarray | None = None) -> dict[str, Any]:
    """The answer to one measured photograph, with advice; `picture` (uint8 H×W×3) is included as a data URI."""
    photo, promise = collection.photos[path], collection.manifest.promise
    entry, is_counted = photo.entry, promise is not None and photo.counted
    prediction = entry.predictions.get(promise.models[0].name) if promise is not None and is_counted else None
    answer = "not counted" if prediction is None else "recognized" if prediction.recognized else "not recognized"
    return {
        "file": f"{path.parent.name}/{path.name}",
        "answer": answer,
        "control": collection.control_of(path),
        "tap": collection.wants_corners(path),
        "label": prediction and f"{prediction.label} {prediction.confidence:.0%}",
        "code": entry.code,
        "advice": "; ".join(filter(None, (entry.remark and entry.remark.advice, *entry.said))) or None,
        "view": _view_words(entry),
        "picture": None if picture is None else data_uri(image_bytes(picture, "JPEG", _PREVIEW_OPTIONS)),
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


def _map(collection: PhotoCollection, wanted: int) -> dict[str, Any] | None:
    """The map of views with names of its columns (degrees) and rows (the piece's share of the picture's shorter side,
    or else pixels per millimeter); None if the promise has no views.
    """
    promise, side_px, photos = collection.manifest.promise, collection.side_px, collection.photos
    counted = [photo.entry for path, photo in photos.items() if photo.counted and collection.control_of(path) is None]
    views = promise and map_views(promise.conditions, counted, wanted, side_px)
    if not views:
        return None
    rows = [f"{low:.1f}–{high:.1f} px/mm" for high, low in pairwise(views.px_per_mm)]
    if side_px is not None:
        share = 100 * collection.manifest.cut_mm[2] / side_px
        rows = [f"{share * low:.0f}–{share * high:.0f} %" for high, low in pairwise(views.px_per_mm)]
    return {
        "columns": [_azimuth_words(low, high) for low, high in pairwise(views.azimuth_deg)],
        "rows": rows,
        "photos": views.photos,
        "wanted": views.wanted,
        "elsewhere": views.elsewhere,
        "next": views.most_missing,
        "of_picture": side_px is not None,
    }


def _azimuth_words(low: float, high: float) -> str:
    """Describe a range of azimuths, as seen by somebody who looks at the piece."""
    if low < 0 < high:
        return f"{-low:.0f}° left to {high:.0f}° right"
    near, far = sorted((abs(low), abs(high)))
    return f"{near:.0f}–{far:.0f}° {'left' if low < 0 else 'right'}"
