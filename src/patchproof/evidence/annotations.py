"""Read what somebody drew in photographs: boxes round the object, and the corners of prints without markers.

Boxes are needed where a detector judges and the sheet does not tell the object's extent: bare objects (without a box
any detection counts), and objects that are not the scene's mesh. In: COCO JSON, as annotation tools and `reprint` write
it, of the photographs or of copies of another size, upright or as stored. Out: by photograph's name its box, in shares
of the upright picture. Left out on purpose: objects in several parts, and annotations of other things.

Corners are the design's own top-left, top-right, bottom-right and bottom-left, in pixels of the upright picture (as
phones and browsers show it; the picture's corner is 0, 0). In: CSV, or COCO JSON, which has them as keypoints or as a
polygon, and says of which size the picture was: points in a copy are scaled. Out: points by photograph. Left
out on purpose: points in pictures as stored, which EXIF turns; corners that the picture's edge cuts off.
"""

import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, PositiveInt

from patchproof.base.csv_file import csv_lines, read_csv
from patchproof.base.errors import Refused
from patchproof.base.geometry import corner_turns
from patchproof.base.input import open_lazily, read_json
from patchproof.base.text import printable
from patchproof.base.validation import Finite, Model, Positive, spelling_hint, summarize_names, validate_model
from patchproof.evidence.classify import BoxEdges
from patchproof.photo.limits import run_limited
from patchproof.photo.read import allow_heic
from patchproof.photo.registration import DesignCorners

CORNERS_FILE = "corners.csv"
CORNER_SIGMA_PX = 2.0  # of a corner that a person names
_COLUMNS = ("file", *(f"{axis}{number}" for number in range(1, 5) for axis in "xy"))
_EXPECTED = f"corners as a CSV of {','.join(_COLUMNS)} or as COCO JSON"
_ORDER = "name the design's own top-left, top-right, bottom-right and bottom-left corner"
_ORIENTATION, _TIFF_WIDTH, _TIFF_HEIGHT = 0x0112, 0x0100, 0x0101  # tags
_SLACK = 0.01  # of a side: copies have whole pixels, and boxes end a little outside

SizePx = tuple[int, int]  # width and height
Found = TypeVar("Found")


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


class _Points(BaseModel):
    image_id: int
    keypoints: tuple[Finite, ...] = ()  # x, y and how visible each one is
    segmentation: tuple[tuple[Finite, ...], ...] | dict[str, Any] = ()


class _CocoPoints(BaseModel):
    images: tuple[CocoImage, ...]
    annotations: tuple[_Points, ...]


class Drawn(NamedTuple):
    """A box's edges (left, top, right, bottom), or four points (x, y) as eight numbers, in pixels of a picture of
    `size_px` (the photograph or a copy of it), if the file says that.
    """

    numbers: tuple[float, ...]
    size_px: SizePx | None = None


def load_boxes(path: str | Path, label: str) -> dict[str, Drawn]:
    """Load boxes by the photograph's name in the file. Boxes are of the category `label`, or of the only one; several
    in one photograph are refused, and boxes outside of it.
    """
    do = "export it again, one box a photograph"
    coco = _read_coco(path, _Coco, "boxes as COCO JSON", do)
    category_ids = [category.id for category in coco.categories if category.name == label]
    if not category_ids and len(coco.categories) == 1:
        category_ids = [coco.categories[0].id]
    if not category_ids:
        names = [category.name for category in coco.categories]
        got = ", ".join(names) or "none"
        raise Refused(f'a category "{label}" of boxes in {path}', got, spelling_hint(label, names))
    annotations = [annotation for annotation in coco.annotations if annotation.category_id in category_ids]
    images, boxes = _images_by_id(coco.images, path), {}
    counts = Counter(annotation.image_id for annotation in annotations)
    for a in annotations:
        name, size_px = images.get(a.image_id, (f"the unknown image {a.image_id}", None))
        if size_px is None or counts[a.image_id] > 1 or a.iscrowd or a.attributes.get("rotation"):
            got = "a group (iscrowd)" if a.iscrowd else f"{counts[a.image_id]} boxes"
            got = f"one turned by {a.attributes['rotation']}°" if a.attributes.get("rotation") else got
            do = "draw one upright box round the whole object"
            raise Refused(f"one box in each photograph of {path}", f"{got} in {name}", do)
        left, top, width, height = a.bbox
        boxes[name] = Drawn((left, top, left + width, top + height), size_px)
    _refuse_outside(boxes, str(path))
    if outlines := sum(bool(annotation.segmentation) for annotation in annotations):
        warnings.warn(f"{outlines} outlines (segmentation) in {path} are left aside: boxes count", stacklevel=2)
    return boxes


def load_corners(path: str | Path) -> dict[str, Drawn]:
    """Load corners by the photograph's name in the file. Refused are other than four points, points that do not run
    clockwise round a convex shape, a photograph named twice, and none at all.
    """
    corners: dict[str, Drawn] = {}
    if (kind := Path(path).suffix.lower()) not in (".csv", ".json"):
        raise Refused(_EXPECTED, f"{path}", "name a file that ends in .csv or .json")
    for name, named in _read_csv_rows(path) if kind == ".csv" else _read_points(path):
        if name in corners or len(named.numbers) != 8:
            got, do = ("two rows", "remove one") if name in corners else (f"{len(named.numbers) / 2:g} points", _ORDER)
            raise Refused(f"four points in each photograph of {path}", f"{got} of {name}", do)
        refuse_twisted(named, name, path)
        corners[name] = named
    if not corners:
        raise Refused(f"corners of the design in {path}", "none of any photograph", _ORDER)
    return corners


def corners_csv(corners: Mapping[str, np.ndarray]) -> str:
    """Format the corners 4×2 px of each photograph as CSV."""
    return csv_lines([_COLUMNS, *([name, *np.round(px, 2).ravel().tolist()] for name, px in corners.items())])


def _read_csv_rows(path: str | Path) -> Iterator[tuple[str, Drawn]]:
    head, *rows = read_csv(path, _EXPECTED) or [[]]
    if tuple(cell.strip().lower() for cell in head) != _COLUMNS:
        raise Refused(_EXPECTED, f'{path} that begins with "{",".join(head)[:60]}"', "add that head as its first line")
    for name, *cells in rows:
        try:
            numbers = tuple(np.asarray_chkfinite(cells, float).tolist())
        except ValueError:
            raise Refused(f"eight numbers for each photograph of {path}", f"{name}: {cells}", _ORDER) from None
        yield printable(name.strip().replace("\\", "/")), Drawn(numbers)


def _read_coco(path: str | Path, model: type[Model], expected: str, do: str) -> Model:
    if not isinstance(content := read_json(path, expected, do), dict):  # a model's results are a list of rows
        got, do = f"{path}, a list without the photographs' names", "export annotations, not results"
        raise Refused(expected, got, do)
    return validate_model(model, content, str(path))


def _read_points(path: str | Path) -> Iterator[tuple[str, Drawn]]:
    coco = _read_coco(path, _CocoPoints, _EXPECTED, _ORDER)
    images = _images_by_id(coco.images, path)
    for each in coco.annotations:
        polygons = each.segmentation if isinstance(each.segmentation, tuple) else ()
        numbers = tuple(v for i, v in enumerate(each.keypoints) if i % 3 < 2) or sum(polygons, ())
        if numbers and all(each.keypoints[2::3]) and each.image_id in images:  # else boxes, or unlabeled: v = 0
            name, size_px = images[each.image_id]
            yield name, Drawn(numbers, size_px)


def _images_by_id(images: Sequence[CocoImage], path: str | Path) -> dict[int, tuple[str, SizePx]]:
    """Names, with slashes between folders, and sizes of images by id; refused if one is listed twice."""
    found = {image.id: (printable(image.file_name.replace("\\", "/")), (image.width, image.height)) for image in images}
    if len({name for name, _ in found.values()}) < len(images):
        (name, count), *_ = Counter(image.file_name for image in images).most_common()
        raise Refused(f"each image once in {path}", f"{name} {count} times, or one id twice", "remove the others")
    return found


def _refuse_outside(boxes: Mapping[str, Drawn], source: str) -> None:
    """Refuse boxes that lie partly outside of their pictures, or are smaller than a pixel; corners of boxes by name."""
    for name, box in boxes.items():
        if not _inside(box):
            (left, top, right, bottom), (width, height) = box.numbers, box.size_px or (0, 0)
            corners = all(_inside(Drawn((x, y, x1 - x, y1 - y), size)) for (x, y, x1, y1), size in boxes.values())
            do = "these are all left, top, right and bottom: write width and height" if corners else "draw it again"
            expected = f"boxes [left, top, width, height] of a pixel or more within their pictures in {source}"
            got = f"[{left:g}, {top:g}, {right - left:g}, {bottom - top:g}] in {name} of {width} × {height} pixels"
            raise Refused(expected, got, do)


def _inside(box: Drawn) -> bool:
    """Check that edges are a pixel or more apart, and lie in the picture."""
    (left, top, right, bottom), (width, height) = box.numbers, box.size_px or (0, 0)
    across, down = 1 + _SLACK * width, 1 + _SLACK * height
    inside = -across <= left and right <= width + across and -down <= top and bottom <= height + down
    return inside and right - left >= 1 and bottom - top >= 1


def refuse_twisted(named: Drawn, name: str, path: str | Path) -> None:
    """Refuse corners of the photograph `name` that do not run clockwise round a convex shape; they came from `path`."""
    turns = corner_turns(np.reshape(named.numbers, (4, 2)))
    if not (turns > 1).all():
        got = "a photograph or order that is mirrored" if (turns < -1).all() else "a shape that is not convex"
        got = "shares of the picture" if max(named.numbers) <= 1 else got
        got += f" ({', '.join(f'{number:g}' for number in named.numbers)} in {name})"
        raise Refused(f"corners in pixels that run clockwise in {path}", got, _ORDER)


def find_in_photos(
    kind: str,
    drawn: Mapping[str, Drawn],
    of_photo: Callable[[Drawn, str, Path], Found | None],
    photos: Sequence[tuple[str, Path]],
) -> tuple[list[Found | None], dict[str, Drawn]]:
    """Apply `of_photo` to what was drawn in photographs (name, path); return the results, and what is of none of them.
    What was drawn in a photograph has its name, or one that ends like it, folders included where both have them.
    Refused if two names mean one photograph, or one means two, or nothing of a `kind` ("": it may lack) was drawn.
    """
    by_last_part: dict[str, list[str]] = {}
    for name in sorted(drawn.keys() - {name for name, _ in photos}):
        by_last_part.setdefault(PurePosixPath(name).name, []).append(name)
    found, uses = list[Found | None](), dict[str, str]()
    for photo, path in photos:
        like = by_last_part.get(PurePosixPath(photo).name, ())
        near = (
            [photo] if photo in drawn else [e for e in like if f"/{photo}".endswith(f"/{e}") or e.endswith(f"/{photo}")]
        )
        if len(near) > 1 or (near and uses.setdefault(near[0], photo) != photo):
            got = f"{near[0]} and {near[1]}" if len(near) > 1 else f"{near[0]} for {uses[near[0]]}, too,"
            raise Refused("one row for each photograph", f"{got} for {photo}", "write folder and file in each row")
        found.append(of_photo(drawn[near[0]], photo, path) if near else None)
    if kind and not any(each is not None for each in found):
        do = "name the files in it as the photographs"
        raise Refused(f"{kind} of these photographs", f"{kind} in {summarize_names(list(drawn))}", do)
    return found, {name: each for name, each in drawn.items() if name not in uses}


def box_of_photo(box: Drawn, name: str, path: Path) -> BoxEdges | None:
    """A box in the photograph `name` at `path`, in shares of the upright photograph's sides; None if the file cannot be
    read. Refused if drawn in a picture of another shape.
    """
    if box.size_px is None or (sizes := _sizes_of(path)) is None:
        return None
    upright_px, stored_px, orientation = sizes
    x, y = (np.clip(np.divide(box.numbers[axis::2], box.size_px[axis]), 0, 1) for axis in (0, 1))
    if not _is_same_shape(box.size_px, upright_px):
        if not _is_same_shape(box.size_px, stored_px):
            (width, height), (w, h) = upright_px, box.size_px
            expected = f"boxes in {name} of {width} × {height} pixels, or in a copy of all of it"
            raise Refused(expected, f"boxes in a picture of {w} × {h}", "draw them in the photographs themselves")
        x, y = y, x  # as stored; then what turns or mirrors it
        x, y = 1 - x[::-1] if orientation in (6, 7) else x, 1 - y[::-1] if orientation in (7, 8) else y
    return float(x[0]), float(y[0]), float(x[1]), float(y[1])


def corners_of_photo(corners: Drawn, name: str, path: Path) -> DesignCorners | None:
    """Corners in the photograph `name` at `path`; None if the file cannot be read. Refused if they were named in a
    picture of another shape.
    """
    px = np.reshape(corners.numbers, (4, 2))
    if corners.size_px is not None:
        if (sizes := _sizes_of(path)) is None:
            return None
        if not _is_same_shape(corners.size_px, sizes[0]):
            expected = f"corners in {name} as it is shown upright, {sizes[0][0]} × {sizes[0][1]} pixels"
            got = f"corners in a picture of {corners.size_px[0]} × {corners.size_px[1]}"
            raise Refused(expected, got, "name them in the photographs themselves, turned as EXIF says")
        px = px * np.divide(sizes[0], corners.size_px)
    return DesignCorners(px, CORNER_SIGMA_PX)


def _sizes_of(path: Path) -> tuple[SizePx, SizePx, int] | None:
    """A photograph's size upright, its size as stored, and its EXIF orientation; None if it cannot be read."""
    try:
        stored_px, orientation = run_limited(_read_orientation, path)
    except Exception:  # it is rejected as unreadable later
        return None
    return (stored_px[1], stored_px[0]) if orientation in (5, 6, 7, 8) else stored_px, stored_px, orientation


def _read_orientation(path: Path) -> tuple[SizePx, int]:
    allow_heic(path)
    with warnings.catch_warnings(action="ignore"), open_lazily(path) as image:
        exif = image.getexif()
        is_tiff = image.format == "TIFF"  # for which Pillow says the upright size
        return (exif[_TIFF_WIDTH], exif[_TIFF_HEIGHT]) if is_tiff else image.size, exif.get(_ORIENTATION, 1)


def _is_same_shape(size_px: SizePx, other_px: SizePx) -> bool:
    """Check that one is a copy of the other at another size, to a pixel or a hundredth."""
    products = size_px[0] * other_px[1], size_px[1] * other_px[0]
    return max(products) - min(products) <= max(_SLACK * max(products), *other_px)
