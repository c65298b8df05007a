"""Photographs and what they show as COCO JSON, so that tools for detectors open them.

In: per photograph its size and the outlines of things in it. Out: the text of a `coco.json`: images by file name,
relative to the folder of photographs, a category for each kind of thing, boxes [x, y, width, height] in pixels of the
upright picture (corners at 0), cut off at its borders. The patch's outline becomes a polygon, too; of the object only
the box is known. What stands in front of what is left out on purpose: boxes are whole ones.
Source: Lin et al., Microsoft COCO, ECCV 2014, and its data format.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

PATCH = "patch"
_LEAST_PX = 1.0  # of a box's sides: less of a thing is not seen


@dataclass(frozen=True, eq=False)
class LabeledPhoto:
    """A photograph: its file, (width, height), and outlines N×2 in its pixels by category; those with NaN (a part is
    behind the camera) are left out.
    """

    file: str
    size_px: tuple[int, int]
    outlines: Mapping[str, np.ndarray] = field(default_factory=dict)


def coco_json(photos: Sequence[LabeledPhoto], label: str, about: str) -> str:
    """The file's text; `label` is the object's category."""
    categories = {label: 1, PATCH: 2} if label != PATCH else {PATCH: 1}
    annotations = []
    for number, photo in enumerate(photos, 1):
        for name, outline in photo.outlines.items():
            shape = _annotation(outline, photo.size_px, name == PATCH)
            if shape is not None:
                ids = {"id": len(annotations) + 1, "image_id": number, "category_id": categories[name]}
                annotations.append(ids | shape)
    images = [
        {"id": number, "file_name": photo.file, "width": photo.size_px[0], "height": photo.size_px[1]}
        for number, photo in enumerate(photos, 1)
    ]
    data = {
        "info": {"description": about},
        "images": images,
        "annotations": annotations,
        "categories": [{"id": number, "name": name} for name, number in categories.items()],
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def _annotation(outline: np.ndarray, size_px: tuple[int, int], is_outline: bool) -> dict[str, Any] | None:
    """Box, area and, of more than a box, the polygon of what lies in the picture; None where that is nothing."""
    if not np.isfinite(outline).all():
        return None
    inside = clip_polygon(outline, size_px)
    if not len(inside) or np.ptp(inside, axis=0).min() < _LEAST_PX:
        return None
    (x, y), (width, height) = inside.min(0).tolist(), np.ptp(inside, axis=0).tolist()
    box = [round(value, 2) for value in (x, y, width, height)]
    if not is_outline:
        return {"bbox": box, "area": round(width * height, 2), "iscrowd": 0}
    following = np.roll(inside, -1, axis=0)
    area = abs(float((inside[:, 0] * following[:, 1] - inside[:, 1] * following[:, 0]).sum())) / 2
    polygon = [round(value, 2) for value in inside.ravel().tolist()]
    return {"bbox": box, "area": round(area, 2), "iscrowd": 0, "segmentation": [polygon]}


def clip_polygon(outline: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """The part M×2 of a polygon N×2 that lies in the picture (Sutherland and Hodgman 1974); M is 0 where none does."""
    points = np.asarray(outline, float)
    for axis, sign, border in ((0, 1, 0), (1, 1, 0), (0, -1, size_px[0]), (1, -1, size_px[1])):
        kept = []
        for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
            depth_a, depth_b = sign * (a[axis] - border), sign * (b[axis] - border)
            if depth_a >= 0:
                kept.append(a)
            if depth_a * depth_b < 0:
                kept.append(a + (b - a) * depth_a / (depth_a - depth_b))
        points = np.array(kept).reshape(-1, 2)
    return points
