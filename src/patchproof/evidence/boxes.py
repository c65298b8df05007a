"""Read the object's boxes that somebody drew in photographs, which detectors are judged by.

They are needed where the sheet does not tell the object's extent: bare objects (without a box any detection counts),
and objects that are not the scene's mesh. In: COCO JSON, as annotation tools and `reprint` write it. Out: by
photograph's name its box in pixels of the upright picture. Left out on purpose: objects in several parts, and
annotations of other things.
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
    """Load boxes (left, top, right, bottom) by the photograph's name in the file, and by its last part if that is
    unique. Boxes are of the category `label`, or of the only one; several in one photograph are refused.
    """
    do = "export it again, one box a photograph"
    coco = validate_model(_Coco, read_json(path, "boxes as COCO JSON", do), str(path))
    category_ids = [category.id for category in coco.categories if category.name == label]
    if not category_ids and len(coco.categories) == 1:
        category_ids = [coco.categories[0].id]
    if not category_ids:
        names = [category.name for category in coco.categories]
        do = spelling_hint(label, names)
        raise Refused(f'a category "{label}" of boxes in {path}', ", ".join(names) or "none", do)
    annotations = [annotation for annotation in coco.annotations if annotation.category_id in category_ids]
    names, counts = {image.id: image.file_name for image in coco.images}, Counter(a.image_id for a in annotations)
    for image_id, count in counts.items():
        if image_id not in names or count > 1:
            got = f"{count} in {names[image_id]}" if image_id in names else f"a box in the unknown image {image_id}"
            raise Refused(f"one box in each photograph of {path}", got, "draw one round the whole object")
    edges = {a.image_id: (left, top, left + w, top + h) for a in annotations for left, top, w, h in [a.bbox]}
    boxes = {names[image_id]: box for image_id, box in edges.items()}
    last_parts = {name: PurePosixPath(name).name for name in boxes}
    uses = Counter(last_parts.values())
    return {last_parts[name]: box for name, box in boxes.items() if uses[last_parts[name]] == 1} | boxes


def box_of_photo(boxes: Mapping[str, BoxEdges], name: str) -> BoxEdges | None:
    """Find a photograph's box by its name, or else by the last part of it."""
    return boxes.get(name, boxes.get(PurePosixPath(name).name))


def box_in_square(box_px: BoxEdges, size_px: tuple[int, int]) -> BoxEdges:
    """Convert a box in pixels to shares of the centered square of a photograph of `size_px`; to all zeros, which no
    detection overlaps, if it lies outside.
    """
    side = min(size_px)
    left, top = ((size - side) / 2 for size in size_px)
    edges = zip(box_px, (left, top, left, top), strict=True)
    x0, y0, x1, y1 = (min(max((value - start) / side, 0.0), 1.0) for value, start in edges)
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else (0.0, 0.0, 0.0, 0.0)


def box_corners_px(box: BoxEdges, size_px: tuple[int, int]) -> np.ndarray:
    """Convert a box of `box_in_square` back to its corners (4×2) in pixels."""
    (width, height), side = size_px, min(size_px)
    x0, y0, x1, y1 = box
    return side * rect_corners((x0, y0, x1 - x0, y1 - y0)) + ((width - side) / 2, (height - side) / 2)
