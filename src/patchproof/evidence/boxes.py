"""Read the object's boxes that somebody drew in photographs, which detectors are judged by.

They are needed where the sheet does not tell the object's extent: bare objects (without a box any detection counts),
and objects that are not the scene's mesh. In: COCO JSON, as annotation tools and `reprint` write it, of the photographs
or of copies of another size, upright or as stored. Out: by photograph's name its box, in shares of the upright picture.
Left out on purpose: objects in several parts, and annotations of other things.
"""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, PositiveInt

from patchproof.base.errors import Refused
from patchproof.base.input import open_lazily, read_json
from patchproof.base.text import printable
from patchproof.base.validation import Finite, Positive, spelling_hint, validate_model
from patchproof.evidence.classify import BoxEdges
from patchproof.photo.limits import run_limited
from patchproof.photo.read import allow_heic

_ORIENTATION, _TIFF_WIDTH, _TIFF_HEIGHT = 0x0112, 0x0100, 0x0101  # tags
_SLACK = 0.01  # of a side: copies have whole pixels, and boxes end a little outside

Drawn = TypeVar("Drawn")


class CocoImage(BaseModel):
    """A picture that COCO JSON lists, with its size."""

    id: int
    file_name: str
    width: PositiveInt
    height: PositiveInt


class _Category(BaseModel):
    id: int
    name: str


class _Annotation(BaseModel):
    image_id: int
    category_id: int
    bbox: tuple[Finite, Finite, Positive, Positive]  # left, top, width, height
    iscrowd: bool = False
    segmentation: Any = None
    attributes: dict[str, Any] = {}


class _Coco(BaseModel):
    images: tuple[CocoImage, ...]
    categories: tuple[_Category, ...]
    annotations: tuple[_Annotation, ...]


class DrawnBox(NamedTuple):
    """A box (left, top, right, bottom) in pixels of a picture of `size_px`: the photograph or a copy of it."""

    edges: BoxEdges
    size_px: tuple[int, int]


def load_boxes(path: str | Path, label: str) -> dict[str, DrawnBox]:
    """Load boxes by the photograph's name in the file, and by its last part if that is unique. Boxes are of the
    category `label`, or of the only one; several in one photograph are refused, and boxes outside of it.
    """
    do = "export it again, one box a photograph"
    coco = validate_model(_Coco, read_json(path, "boxes as COCO JSON", do), str(path))
    category_ids = [category.id for category in coco.categories if category.name == label]
    if not category_ids and len(coco.categories) == 1:
        category_ids = [coco.categories[0].id]
    if not category_ids:
        names = [category.name for category in coco.categories]
        got = ", ".join(names) or "none"
        raise Refused(f'a category "{label}" of boxes in {path}', got, spelling_hint(label, names))
    annotations = [annotation for annotation in coco.annotations if annotation.category_id in category_ids]
    images = {image.id: image for image in coco.images}
    names = image_names(coco.images, path)
    counts, boxes = Counter(annotation.image_id for annotation in annotations), {}
    for a in annotations:
        if a.image_id not in names or counts[a.image_id] > 1 or a.iscrowd or a.attributes.get("rotation"):
            got = "a group (iscrowd)" if a.iscrowd else f"{counts[a.image_id]} boxes"
            got = f"one turned by {a.attributes['rotation']}°" if a.attributes.get("rotation") else got
            got += f" in {names.get(a.image_id, f'the unknown image {a.image_id}')}"
            raise Refused(f"one box in each photograph of {path}", got, "draw one upright box round the whole object")
        (left, top, width, height), image = a.bbox, images[a.image_id]
        edges = left, top, left + width, top + height
        boxes[names[a.image_id]] = DrawnBox(edges, (image.width, image.height))
    _refuse_outside(boxes, str(path))
    if outlines := sum(bool(annotation.segmentation) for annotation in annotations):
        warnings.warn(f"{outlines} outlines (segmentation) in {path} are left aside: boxes count", stacklevel=2)
    return with_last_parts(boxes)


def image_names(images: Sequence[CocoImage], path: str | Path) -> dict[int, str]:
    """Names of images by id, with slashes between folders; refused if one is listed twice."""
    names = {image.id: printable(image.file_name.replace("\\", "/")) for image in images}
    if len(set(names.values())) < len(images):
        (name, count), *_ = Counter(image.file_name for image in images).most_common()
        raise Refused(f"each image once in {path}", f"{name} {count} times, or one id twice", "remove the others")
    return names


def with_last_parts(drawn: dict[str, Drawn]) -> dict[str, Drawn]:
    """What was drawn in photographs by name, and by the last part of the name where that is unique."""
    last_parts = {name: PurePosixPath(name).name for name in drawn}
    uses = Counter(last_parts.values())
    return {last_parts[name]: each for name, each in drawn.items() if uses[last_parts[name]] == 1} | drawn


def _refuse_outside(boxes: Mapping[str, DrawnBox], source: str) -> None:
    """Refuse boxes that lie partly outside of their pictures, or are smaller than a pixel; corners of boxes by name."""
    for name, (edges, size_px) in boxes.items():
        if not _inside(edges, size_px):
            (left, top, right, bottom), (width, height) = edges, size_px
            corners = all(_inside((x, y, x1 - x, y1 - y), size) for (x, y, x1, y1), size in boxes.values())
            do = "these are all left, top, right and bottom: write width and height" if corners else "draw it again"
            expected = f"boxes [left, top, width, height] of a pixel or more within their pictures in {source}"
            got = f"[{left:g}, {top:g}, {right - left:g}, {bottom - top:g}] in {name} of {width} × {height} pixels"
            raise Refused(expected, got, do)


def _inside(edges: BoxEdges, size_px: tuple[int, int]) -> bool:
    """Check that edges are a pixel or more apart, and lie in a picture."""
    (left, top, right, bottom), (width, height) = edges, size_px
    across, down = 1 + _SLACK * width, 1 + _SLACK * height
    inside = -across <= left and right <= width + across and -down <= top and bottom <= height + down
    return inside and right - left >= 1 and bottom - top >= 1


def box_of_photo(boxes: Mapping[str, DrawnBox], name: str, path: Path) -> BoxEdges | None:
    """Find the box of the photograph at `path` by its name, or else by the last part of it, in shares of the upright
    photograph's sides; None if there is none, or the file cannot be read. Refused if it was drawn in a picture of
    another shape.
    """
    drawn = boxes.get(name, boxes.get(PurePosixPath(name).name))
    try:
        return None if drawn is None else _shares(drawn, name, *run_limited(read_orientation, path))
    except Refused:
        raise
    except Exception:  # it is rejected as unreadable later
        return None


def read_orientation(path: Path) -> tuple[tuple[int, int], int]:
    """The size (width, height) that a photograph is stored in, and its EXIF orientation."""
    allow_heic(path)
    with warnings.catch_warnings(action="ignore"), open_lazily(path) as image:
        exif = image.getexif()
        is_tiff = image.format == "TIFF"  # for which Pillow says the upright size
        return (exif[_TIFF_WIDTH], exif[_TIFF_HEIGHT]) if is_tiff else image.size, exif.get(_ORIENTATION, 1)


def _shares(drawn: DrawnBox, name: str, stored_px: tuple[int, int], orientation: int) -> BoxEdges:
    upright_px = (stored_px[1], stored_px[0]) if orientation in (5, 6, 7, 8) else stored_px
    x, y = (np.clip(np.divide(drawn.edges[axis::2], drawn.size_px[axis]), 0, 1) for axis in (0, 1))
    if not is_same_shape(drawn.size_px, upright_px):
        if not is_same_shape(drawn.size_px, stored_px):
            (width, height), (w, h) = upright_px, drawn.size_px
            expected = f"boxes in {name} of {width} × {height} pixels, or in a copy of all of it"
            raise Refused(expected, f"boxes in a picture of {w} × {h}", "draw them in the photographs themselves")
        x, y = y, x  # as stored; then what turns or mirrors it
        x, y = 1 - x[::-1] if orientation in (6, 7) else x, 1 - y[::-1] if orientation in (7, 8) else y
    return float(x[0]), float(y[0]), float(x[1]), float(y[1])


def is_same_shape(size_px: tuple[int, int], other_px: tuple[int, int]) -> bool:
    """Check that one is a copy of the other at another size, to a pixel or a hundredth."""
    products = size_px[0] * other_px[1], size_px[1] * other_px[0]
    return max(products) - min(products) <= max(_SLACK * max(products), *other_px)
