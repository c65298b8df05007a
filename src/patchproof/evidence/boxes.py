"""Boxes that somebody drew round the object, for detectors: of photographs whose sheet does not tell where the object
ends, since they show none (bare ones; there whatever is found counts), or since the object is not the scene's mesh.

In: COCO JSON, as annotation tools and `reprint` write it. Out: per photograph's name its box in pixels of the upright
picture. Left out on purpose: objects in several parts, and any other thing that is drawn.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np
from pydantic import BaseModel

from patchproof.base.errors import Refused
from patchproof.base.geometry import rect_corners
from patchproof.base.input import read_json
from patchproof.base.validation import Finite, Positive, spelling_hint, validate_model
from patchproof.evidence.classify import BoxEdges


class _Image(BaseModel):
    id: int
    file_name: str


class _Category(BaseModel):
    id: int
    name: str


class _Annotation(BaseModel):
    image_id: int
    category_id: int
    bbox: tuple[Finite, Finite, Positive, Positive]  # left, top, width, height


class _Coco(BaseModel):
    images: tuple[_Image, ...]
    categories: tuple[_Category, ...]
    annotations: tuple[_Annotation, ...]


def load_boxes(path: str | Path, label: str) -> dict[str, BoxEdges]:
    """(left, top, right, bottom) by a photograph's name in the file, and by its last part where no other has it, of the
    category `label`, or of the only one; refused where a photograph has more than one.
    """
    do = "export it again, one box a photograph"
    coco = validate_model(_Coco, read_json(path, "boxes as COCO JSON", do), str(path))
    ours = [category.id for category in coco.categories if category.name == label]
    if not ours and len(coco.categories) == 1:
        ours = [coco.categories[0].id]
    if not ours:
        known = [category.name for category in coco.categories]
        raise Refused(
            f'a category "{label}" of boxes in {path}', ", ".join(known) or "none", spelling_hint(label, known)
        )
    drawn = [annotation for annotation in coco.annotations if annotation.category_id in ours]
    names, often = {image.id: image.file_name for image in coco.images}, Counter(each.image_id for each in drawn)
    for image_id, count in often.items():
        if image_id not in names or count > 1:
            found = f"{count} in {names[image_id]}" if image_id in names else f"one of the unknown image {image_id}"
            raise Refused(f"one box of each photograph in {path}", found, "draw one round the whole object")
    corners = {each.image_id: (left, top, left + w, top + h) for each in drawn for left, top, w, h in [each.bbox]}
    boxes = {names[image_id]: box for image_id, box in corners.items()}
    last = {name: PurePosixPath(name).name for name in boxes}
    alone = Counter(last.values())
    return {last[name]: box for name, box in boxes.items() if alone[last[name]] == 1} | boxes


def box_of_photo(boxes: Mapping[str, BoxEdges], name: str) -> BoxEdges | None:
    """The box of the photograph of that name, or else of its last part."""
    return boxes.get(name, boxes.get(PurePosixPath(name).name))


def box_in_square(box_px: BoxEdges, size_px: tuple[int, int]) -> BoxEdges:
    """The box as shares of the centered square of a photograph of `size_px`; all zeros, which nothing overlaps, where
    none of it lies in there.
    """
    side = min(size_px)
    left, top = ((size - side) / 2 for size in size_px)
    x0, y0, x1, y1 = (
        min(max((value - start) / side, 0.0), 1.0) for value, start in zip(box_px, (left, top, left, top), strict=True)
    )
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else (0.0, 0.0, 0.0, 0.0)


def box_corners_px(box: BoxEdges, size_px: tuple[int, int]) -> np.ndarray:
    """The corners 4×2 in pixels of a box that `box_in_square` gave."""
    (width, height), side = size_px, min(size_px)
    x0, y0, x1, y1 = box
    return side * rect_corners((x0, y0, x1 - x0, y1 - y0)) + ((width - side) / 2, (height - side) / 2)
