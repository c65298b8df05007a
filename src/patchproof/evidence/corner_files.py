"""Read and write where the corners of prints without markers lie in photographs: CSV, or COCO JSON of annotation tools.

In: a file with four points a photograph: the design's own top-left, top-right, bottom-right and bottom-left, in pixels
of the upright picture (as phones and browsers show it; the picture's corner is 0, 0). COCO JSON has them as keypoints
or as a polygon, and says of which size the picture was: points in a copy are scaled. Out: `NamedCorners` by photograph.
Left out on purpose: points in pictures as stored, which EXIF turns; corners that the picture's edge cuts off.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from patchproof.base.csv_file import csv_lines, read_csv
from patchproof.base.errors import Refused
from patchproof.base.input import read_json
from patchproof.base.text import printable
from patchproof.base.validation import Finite, validate_model
from patchproof.evidence.boxes import CocoImage, image_names, is_same_shape, read_orientation, with_last_parts
from patchproof.photo.corners import DesignCorners
from patchproof.photo.limits import run_limited

CORNERS_FILE = "corners.csv"
CORNER_SIGMA_PX = 2.0  # of a corner that a person names
_COLUMNS = ("file", *(f"{axis}{number}" for number in range(1, 5) for axis in "xy"))
_EXPECTED = f"corners as a CSV of {','.join(_COLUMNS)} or as COCO JSON"
_ORDER = "name the design's own top-left, top-right, bottom-right and bottom-left corner"


class NamedCorners(NamedTuple):
    """Four points (x, y) as eight numbers, and the size of the picture they were named in, if the file says it."""

    numbers: tuple[float, ...]
    size_px: tuple[int, int] | None = None


class _Points(BaseModel):
    image_id: int
    keypoints: tuple[Finite, ...] = ()  # x, y and how visible each one is
    segmentation: tuple[tuple[Finite, ...], ...] | dict[str, Any] = ()


class _CocoPoints(BaseModel):
    images: tuple[CocoImage, ...]
    annotations: tuple[_Points, ...]


def corners_csv(corners: Mapping[str, np.ndarray]) -> str:
    """Format the corners 4×2 px of each photograph as CSV."""
    return csv_lines([_COLUMNS, *([name, *np.round(px, 2).ravel().tolist()] for name, px in corners.items())])


def load_corners(path: str | Path) -> dict[str, NamedCorners]:
    """Load corners by the photograph's name in the file, and by its last part if that is unique. Refused are other than
    four points, points that do not run clockwise round a convex shape, and a photograph named twice.
    """
    corners: dict[str, NamedCorners] = {}
    for name, named in _read_csv_rows(path) if Path(path).suffix.lower() == ".csv" else _read_coco(path):
        if name in corners or len(named.numbers) != 8:
            got = "two rows" if name in corners else f"{len(named.numbers) / 2:g} points"
            raise Refused(f"four points in each photograph of {path}", f"{got} of {name}", _ORDER)
        refuse_twisted(named, name, path)
        corners[name] = named
    return with_last_parts(corners)


def _read_csv_rows(path: str | Path) -> Iterator[tuple[str, NamedCorners]]:
    head, *rows = read_csv(path, _EXPECTED) or [[]]
    if tuple(cell.strip().lower() for cell in head) != _COLUMNS:
        raise Refused(_EXPECTED, f'{path} that begins with "{",".join(head)[:60]}"', "add that head as its first line")
    for name, *cells in rows:
        try:
            numbers = tuple(float(cell) for cell in cells)
        except ValueError:
            raise Refused(f"eight numbers for each photograph of {path}", f"{name}: {cells}", _ORDER) from None
        yield printable(name.replace("\\", "/")), NamedCorners(numbers)


def _read_coco(path: str | Path) -> Iterator[tuple[str, NamedCorners]]:
    coco = validate_model(_CocoPoints, read_json(path, _EXPECTED, _ORDER), str(path))
    names, images = image_names(coco.images, path), {image.id: image for image in coco.images}
    for each in coco.annotations:
        polygons = each.segmentation if isinstance(each.segmentation, tuple) else ()
        numbers = tuple(v for i, v in enumerate(each.keypoints) if i % 3 < 2) or sum(polygons, ())
        if numbers and each.image_id in images:  # others are boxes of something
            image = images[each.image_id]
            yield names[each.image_id], NamedCorners(numbers, (image.width, image.height))


def refuse_twisted(named: NamedCorners, name: str, path: str | Path) -> None:
    """Refuse corners of the photograph `name` that do not run clockwise round a convex shape; they came from `path`."""
    sides = np.diff(np.reshape(named.numbers, (4, 2))[[0, 1, 2, 3, 0]], axis=0)
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]  # twice the area of each corner's triangle
    if not (turns > 1).all():
        got = "a photograph or order that is mirrored" if (turns < -1).all() else "a shape that is not convex"
        got += f" ({', '.join(f'{number:g}' for number in named.numbers)} in {name})"
        raise Refused(f"corners that run clockwise in {path}", got, _ORDER)


def corners_of_photo(corners: Mapping[str, NamedCorners], name: str, path: Path) -> DesignCorners | None:
    """Find the corners in the photograph at `path` by its name, or else by the last part of it; None if there are none.
    Refused if they were named in a picture of another shape.
    """
    named = corners.get(name, corners.get(PurePosixPath(name).name))
    if named is None:
        return None
    px = np.reshape(named.numbers, (4, 2))
    if named.size_px is not None:
        try:
            stored_px, orientation = run_limited(read_orientation, path)
        except Exception:  # it is rejected as unreadable later
            return None
        size_px = (stored_px[1], stored_px[0]) if orientation in (5, 6, 7, 8) else stored_px
        if not is_same_shape(named.size_px, size_px):
            expected = f"corners in {name} as it is shown upright, {size_px[0]} × {size_px[1]} pixels"
            got = f"corners in a picture of {named.size_px[0]} × {named.size_px[1]}"
            raise Refused(expected, got, "name them in the photographs themselves, turned as EXIF says")
        px = px * np.divide(size_px, named.size_px)
    return DesignCorners(px, CORNER_SIGMA_PX)
