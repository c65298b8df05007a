"""Write photographs and outlines of patch and object as COCO JSON, which tools for detectors open.

In: per photograph its size and outlines by category. Out: the text of a `coco.json`: images by file name, relative to
the folder of photographs, categories, boxes [x, y, width, height] in pixels of the upright picture (corners at 0),
clipped at its borders. The patch's outline is also a polygon; of the object only the box is known. Left out on purpose:
occlusion, so that boxes include hidden parts. Source: Lin et al., Microsoft COCO, ECCV 2014, and its data format.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from patchproof.base.output import json_text

PATCH = "patch"
_LEAST_PX = 1.0  # of a box's sides; smaller boxes are left out


@dataclass(frozen=True, eq=False)
class LabeledPhoto:
    """A photograph: its file, (width, height), `outlines` N×2 px by category (those with NaN, partly behind the camera,
    are left out), and how the patch was located.
    """

    file: str
    size_px: tuple[int, int]
    outlines: Mapping[str, np.ndarray] = field(default_factory=dict)
    located: str | None = None


def coco_json(photos: Sequence[LabeledPhoto], label: str, about: str) -> str:
    """Make the text of a `coco.json`; `label` is the object's category, `about` the description."""
    categories = {label: 1, PATCH: 2} if label != PATCH else {PATCH: 1}
    images, annotations = [], []
    for number, photo in enumerate(photos, 1):
        width, height = photo.size_px
        images.append({"id": number, "file_name": photo.file, "width": width, "height": height})
        for name, outline in photo.outlines.items():
            shape = _annotation(outline, photo.size_px, name == PATCH)
            if shape is not None:
                ids = {"id": len(annotations) + 1, "image_id": number, "category_id": categories[name]}
                extra = {"attributes": {"located": photo.located}} if photo.located and name == PATCH else {}
                annotations.append(ids | shape | extra)
    data = {
        "info": {"description": about},
        "images": images,
        "annotations": annotations,
        "categories": [{"id": number, "name": name} for name, number in categories.items()],
    }
    return json_text(data)


def _annotation(outline: np.ndarray, size_px: tuple[int, int], with_polygon: bool) -> dict[str, Any] | None:
    """Box, area and optionally polygon of the outline's part in the picture; None if that is smaller than a pixel."""
    if not np.isfinite(outline).all():
        return None
    visible = clip_polygon(outline, size_px)
    if not len(visible) or np.ptp(visible, axis=0).min() < _LEAST_PX:
        return None
    (x, y), (width, height) = visible.min(0).tolist(), np.ptp(visible, axis=0).tolist()
    box = [round(value, 2) for value in (x, y, width, height)]
    if not with_polygon:
        return {"bbox": box, "area": round(width * height, 2), "iscrowd": 0}
    following = np.roll(visible, -1, axis=0)
    area = abs(float((visible[:, 0] * following[:, 1] - visible[:, 1] * following[:, 0]).sum())) / 2
    polygon = [round(value, 2) for value in visible.ravel().tolist()]
    return {"bbox": box, "area": round(area, 2), "iscrowd": 0, "segmentation": [polygon]}


def clip_polygon(outline: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Clip a polygon N×2 to the picture (Sutherland and Hodgman 1974): M×2, with M = 0 if it lies outside."""
    points = np.asarray(outline, float)
    for axis, sign, border in ((0, 1, 0), (1, 1, 0), (0, -1, size_px[0]), (1, -1, size_px[1])):
        clipped = []
        for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
            depth_a, depth_b = sign * (a[axis] - border), sign * (b[axis] - border)
            if depth_a >= 0:
                clipped.append(a)
            if depth_a * depth_b < 0:
                clipped.append(a + (b - a) * depth_a / (depth_a - depth_b))
        points = np.array(clipped).reshape(-1, 2)
    return points
