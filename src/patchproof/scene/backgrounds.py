"""Places behind the object: photographs in a folder, one known picture, procedural places, or one plain color.

In: the settings and, per view, five numbers in [0, 1) that choose picture, crop and mirroring. Out: H×W×3 uint8 sRGB.
The photograph and its centered square show the same crop, so that what trains and what is photographed agree.

Each file of a folder belongs to one part only: to what trains, selects, promises, or is reprinted and evaluated. A rate
in places that training knows would say little of the place where somebody will take photographs. Parts with few files
have procedural places (`rooms`) beside them: training a few that it learns, a promise another one for every session,
since only from many places it knows how much places differ. A picture that is named itself is the known place of all
parts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np

from patchproof.base.color import codes_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, is_folder, open_image
from patchproof.base.resample import halving_pyramid, index_homography
from patchproof.base.settings import BackgroundSettings
from patchproof.base.validation import expand_path
from patchproof.scene.procedural_places import procedural_place

SMALLEST_CROP = 0.6  # of the largest crop that fits
FEW_PICTURES = 10  # files of which the scene is told that they are few
# The procedural places of each part, by number.
ROOMS = {
    "train": range(24),
    "select": range(1_000, 1_024),
    "promise": range(10_000, 20_000),
    "evaluate": range(20_000, 30_000),
}
ENOUGH_FILES = 24  # files that need no procedural places beside them, of a part that learns or selects
FILE_WEIGHT = 4  # where a file is seen as often as so many procedural places
VIEWS_PER_FILE = 50  # elsewhere a file is seen in one view of so many, lest a rate hang on two or three
# whose the files are, in the order of a hash of their names, again and again
_DEALT = ("train", "promise", "evaluate", "select", "train", "promise", "train", "evaluate", "promise", "train")
_KEPT = 192  # procedural places at a time, with their halvings 0.3 MB each; drawing one takes 12 ms
_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"}


@dataclass(frozen=True)
class _Part:
    """A part's `files` pictures from `first`, the procedural places after them, and the share of views with files."""

    first: int
    files: int
    rooms: int
    share: float


@dataclass(frozen=True)
class Backgrounds:
    """Pictures as uint8 H×W×3 or numbers of procedural places, a single 1×1 picture where the background is plain; by
    stream the part that it may show, all where it is not named.
    """

    pictures: tuple[np.ndarray | int, ...]
    of_stream: Mapping[str, _Part] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def chosen(self, stream: str, choice: np.ndarray) -> np.ndarray:
        """Numbers in [0, 1) that choose among all pictures, from numbers that choose among a stream's."""
        part = self.of_stream.get(stream, _Part(0, len(self.pictures), 0, 1.0))
        of_files = np.floor(choice / max(part.share, 1e-9) * part.files)
        of_rooms = part.files + np.floor((choice - part.share) / max(1 - part.share, 1e-9) * part.rooms)
        return (part.first + np.where(choice < part.share, of_files, of_rooms) + 0.5) / len(self.pictures)

    @cached_property
    def _reduced(self) -> dict[int, list[np.ndarray]]:
        """Pictures with their halvings as they come into use, so that a small view does not read megapixels."""
        return {}

    def _levels(self, number: int) -> list[np.ndarray]:
        picture = self.pictures[number]
        if isinstance(picture, int):
            return _place_levels(picture)
        if number not in self._reduced:
            self._reduced[number] = halving_pyramid(picture)
        return self._reduced[number]

    def picture(self, choice: np.ndarray, photo_px: tuple[int, int], size_px: tuple[int, int]) -> np.ndarray:
        """What lies behind a view of `size_px`: the whole photograph or, where square, its centered square."""
        levels = self._levels(int(choice[0] * len(self.pictures)))
        height, width = levels[0].shape[:2]
        # a crop with the photograph's aspect
        largest = min(width / photo_px[0], height / photo_px[1])
        share = SMALLEST_CROP + (1 - SMALLEST_CROP) * choice[1]
        crop_w, crop_h = photo_px[0] * largest * share, photo_px[1] * largest * share
        x0, y0 = choice[2] * (width - crop_w), choice[3] * (height - crop_h)
        if size_px[0] == size_px[1]:
            side = min(crop_w, crop_h)
            x0, y0, crop_w, crop_h = x0 + (crop_w - side) / 2, y0 + (crop_h - side) / 2, side, side
        level = 0
        while level + 1 < len(levels) and crop_w / 2 ** (level + 1) >= size_px[0]:
            level += 1
        shrunk = levels[level]
        sx, sy = shrunk.shape[1] / width, shrunk.shape[0] / height
        scale_x, scale_y = crop_w * sx / size_px[0], crop_h * sy / size_px[1]
        matrix = index_homography(np.array([[scale_x, 0, x0 * sx], [0, scale_y, y0 * sy], [0, 0, 1.0]]))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        picture = cv2.warpAffine(shrunk, matrix[:2], size_px, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return picture[:, ::-1] if choice[4] < 0.5 else picture


@lru_cache(maxsize=_KEPT)
def _place_levels(number: int) -> list[np.ndarray]:
    return halving_pyramid(procedural_place(number))


def load_backgrounds(settings: BackgroundSettings, base: Path) -> Backgrounds:
    """The scene's backgrounds; refused where the folder is missing, empty, or holds a picture that cannot be read."""
    if settings.color is not None:
        return Backgrounds((codes_from_srgb(np.array(settings.color)).reshape(1, 1, 3),))
    if settings.images is None:
        return _in_parts([])
    folder = Path(expand_path(settings.images, base))
    if is_file(folder):
        return Backgrounds((_read(folder),))
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES) if is_folder(folder) else []
    if not files:
        raise Refused(
            "a folder of pictures (background.images)", f"none in {folder}", "put photographs there or give a color"
        )
    return _in_parts(files)


def _in_parts(files: Sequence[Path]) -> Backgrounds:
    """Files dealt to the parts, which procedural places fill up."""
    files = sorted(files, key=lambda file: hashlib.sha256(file.name.encode()).digest())
    pictures: list[np.ndarray | int] = []
    parts = {}
    for name, rooms in ROOMS.items():
        own = [file for i, file in enumerate(files) if _DEALT[i % len(_DEALT)] == name]
        if name in ("train", "select"):
            share = 1.0 if len(own) >= ENOUGH_FILES else FILE_WEIGHT * len(own) / (FILE_WEIGHT * len(own) + len(rooms))
        else:
            share = min(1.0, len(own) / VIEWS_PER_FILE)
        parts[name] = _Part(len(pictures), len(own), len(rooms) if share < 1 else 0, share)
        pictures += [*map(_read, own), *(rooms if share < 1 else ())]
    notes = ()
    if 0 < len(files) < FEW_PICTURES:
        notes = (
            f"only {len(files)} pictures in background.images: procedural places stand in for real ones; with {FEW_PICTURES} or "
            "more, training and promise know different ones",
        )
    return Backgrounds(tuple(pictures), parts | {"reprint": parts["evaluate"]}, notes)


def _read(file: Path) -> np.ndarray:
    from PIL import ImageOps

    with open_image(file, "a background picture", "remove or replace it") as image:
        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
