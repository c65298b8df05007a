"""Backgrounds behind the object: photographs in a folder, one known picture, procedural places, or one plain color.

In: the settings and, per view, five numbers in [0, 1) that choose picture, crop and mirroring. Out: H×W×3 uint8 sRGB.
The photograph and its centered square show the same crop, so that training and photographing agree.

Each file of a folder belongs to one purpose only: to train, to select, to promise, or to reprint and evaluate. A rate
at places that training knows would say little about the place where somebody will take photographs. A purpose with few
files gets procedural places (`procedural_places`), too: training gets a few, which it learns; a promise gets another
one for every session, because only many places tell how much places differ. A picture that the settings name itself is
the known place for all purposes.
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
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene.procedural_places import procedural_place

MIN_CROP_SHARE = 0.6  # of the largest crop that fits
FEW_PICTURES = 10  # with fewer files than this, the scene notes that they are few
# Numbers of each purpose's procedural places.
PLACE_NUMBERS = {
    "train": range(24),
    "select": range(1_000, 1_024),
    "promise": range(10_000, 20_000),
    "evaluate": range(20_000, 30_000),
}
ENOUGH_FILES = 24  # training and selection with this many files need no procedural places
FILE_WEIGHT = 4  # with fewer, they see a file as often as this many procedural places
VIEWS_PER_FILE = 50  # other purposes see a file in one of this many views: a rate must not depend on two or three
# the purposes of files in the order of a hash of their names, repeated
_SPLIT_PATTERN = ("train", "promise", "evaluate", "select", "train", "promise", "train", "evaluate", "promise", "train")
CACHED_FILE_BYTES = 1 << 28  # of halvings: a view of 224 px needs 2 MB of one
_CACHED_PLACES = 192  # with their halvings 0.3 MB each; drawing one takes 12 ms
_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"}


@dataclass(frozen=True)
class _Split:
    """One purpose's `files` pictures from `first` on; procedural places after them; the share of views with files."""

    first: int
    files: int
    rooms: int
    share: float


class FileLevels:
    """A picture's file and its halvings, decoded as they come into use: a cache holds those that were used last."""

    def __init__(self, path: Path):
        self.path = path
        with open_image(path, "a background picture", "remove or replace it"):
            pass  # what is no picture is refused before anything is computed

    @cached_property
    def _shapes(self) -> list[tuple[int, int]]:
        return [level.shape[:2] for level in _decoded(self)]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the picture."""
        return self._shapes[0]

    def __len__(self) -> int:
        return len(self._shapes)

    def __getitem__(self, number: int) -> np.ndarray:
        level = _file_levels.pop((self, number), None)
        _file_levels[self, number] = _decoded(self)[number] if level is None else level
        while len(_file_levels) > 1 and sum(each.nbytes for each in _file_levels.values()) > CACHED_FILE_BYTES:
            del _file_levels[next(iter(_file_levels))]  # the one that was used first
        return _file_levels[self, number]


_file_levels: dict[tuple[FileLevels, int], np.ndarray] = {}


@lru_cache(maxsize=1)
def _decoded(file: FileLevels) -> list[np.ndarray]:
    """All levels of the file that was decoded last."""
    try:
        return halving_pyramid(read_photo(file.path).srgb)
    except PhotoRejected as rejection:
        got = f"{file.path.name} that cannot be read ({rejection.advice})"
        raise Refused("a background picture", got, "remove or replace it") from rejection


@dataclass(frozen=True)
class Backgrounds:
    """Pictures as files, uint8 H×W×3 or numbers of procedural places; a single 1×1 picture if the background is plain.
    `of_stream` holds the pictures that a stream may show; a stream that is not in it may show all.
    """

    pictures: tuple[np.ndarray | int | FileLevels, ...]
    of_stream: Mapping[str, _Split] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def choose_for_stream(self, stream: str, choice: np.ndarray) -> np.ndarray:
        """Turn numbers in [0, 1) that choose among a stream's pictures into numbers that choose among all pictures."""
        part = self.of_stream.get(stream, _Split(0, len(self.pictures), 0, 1.0))
        of_files = np.floor(choice / max(part.share, 1e-9) * part.files)
        of_rooms = part.files + np.floor((choice - part.share) / max(1 - part.share, 1e-9) * part.rooms)
        return (part.first + np.where(choice < part.share, of_files, of_rooms) + 0.5) / len(self.pictures)

    @cached_property
    def _halvings(self) -> dict[int, list[np.ndarray]]:
        """Halvings of pictures, added as they come into use, so that a small view does not read megapixels."""
        return {}

    def _levels(self, number: int) -> Sequence[np.ndarray] | FileLevels:
        picture = self.pictures[number]
        if isinstance(picture, FileLevels):
            return picture
        if isinstance(picture, int):
            return _place_levels(picture)
        if number not in self._halvings:
            self._halvings[number] = halving_pyramid(picture)
        return self._halvings[number]

    def picture(self, choice: np.ndarray, photo_px: tuple[int, int], size_px: tuple[int, int]) -> np.ndarray:
        """Return the background of a view of `size_px`: the whole photograph or, if square, its centered square."""
        levels = self._levels(int(choice[0] * len(self.pictures)))
        height, width = levels.shape if isinstance(levels, FileLevels) else levels[0].shape[:2]
        # a crop with the photograph's aspect
        largest = min(width / photo_px[0], height / photo_px[1])
        share = MIN_CROP_SHARE + (1 - MIN_CROP_SHARE) * choice[1]
        crop_w, crop_h = photo_px[0] * largest * share, photo_px[1] * largest * share
        x0, y0 = choice[2] * (width - crop_w), choice[3] * (height - crop_h)
        if size_px[0] == size_px[1]:
            side = min(crop_w, crop_h)
            x0, y0, crop_w, crop_h = x0 + (crop_w - side) / 2, y0 + (crop_h - side) / 2, side, side
        shrunk = levels[max(i for i in range(len(levels)) if i == 0 or crop_w / 2**i >= size_px[0])]
        sx, sy = shrunk.shape[1] / width, shrunk.shape[0] / height
        scale_x, scale_y = crop_w * sx / size_px[0], crop_h * sy / size_px[1]
        matrix = index_homography(np.array([[scale_x, 0, x0 * sx], [0, scale_y, y0 * sy], [0, 0, 1.0]]))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        picture = cv2.warpAffine(shrunk, matrix[:2], size_px, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return picture[:, ::-1] if choice[4] < 0.5 else picture


@lru_cache(maxsize=_CACHED_PLACES)
def _place_levels(number: int) -> list[np.ndarray]:
    return halving_pyramid(procedural_place(number))


def load_backgrounds(settings: BackgroundSettings, base: Path) -> Backgrounds:
    """Load the scene's backgrounds; refused if the folder is missing or empty or a picture cannot be read."""
    if settings.color is not None:
        return Backgrounds((codes_from_srgb(np.array(settings.color)).reshape(1, 1, 3),))
    if settings.images is None:
        return _split_by_purpose([])
    folder, files = Path(expand_path(settings.images, base)), background_files(settings, base)
    if files == [folder]:
        return Backgrounds((FileLevels(folder),))
    if not files:
        remedy = "put some there or give a color"
        raise Refused("a folder of pictures (background.images)", f"no picture in {folder}", remedy)
    return _split_by_purpose(files)


def background_files(settings: BackgroundSettings, base: Path) -> list[Path]:
    """List the pictures that the settings name: those in a folder, or a file; none without `images`."""
    path = None if settings.images is None else Path(expand_path(settings.images, base))
    if path is None or is_file(path):
        return [] if path is None else [path]
    return sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES) if is_folder(path) else []


def _split_by_purpose(files: Sequence[Path]) -> Backgrounds:
    """Split files by purpose, and fill up with procedural places."""
    files = sorted(files, key=lambda file: hashlib.sha256(file.name.encode()).digest())
    pictures: list[np.ndarray | int | FileLevels] = []
    parts = {}
    for name, rooms in PLACE_NUMBERS.items():
        split_files = [file for i, file in enumerate(files) if _SPLIT_PATTERN[i % len(_SPLIT_PATTERN)] == name]
        if name in ("train", "select"):
            weight = FILE_WEIGHT * len(split_files)
            share = 1.0 if len(split_files) >= ENOUGH_FILES else weight / (weight + len(rooms))
        else:
            share = min(1.0, len(split_files) / VIEWS_PER_FILE)
        parts[name] = _Split(len(pictures), len(split_files), len(rooms) if share < 1 else 0, share)
        pictures += [*map(FileLevels, split_files), *(rooms if share < 1 else ())]
    notes = ()
    if 0 < len(files) < FEW_PICTURES:
        notes = (
            f"only {len(files)} pictures in background.images: procedural places stand in for real ones; "
            f"with {FEW_PICTURES} or more, training and promise know different ones",
        )
    return Backgrounds(tuple(pictures), parts | {"reprint": parts["evaluate"]}, notes)
