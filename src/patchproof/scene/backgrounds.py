"""Backgrounds behind the object: photographs in a folder, one known picture, procedural places, or one plain color.

In: the settings and, per view, five numbers in [0, 1) that choose picture, crop and mirroring. Out: H×W×3 uint8 sRGB.
The photograph and its centered square show the same crop, so that training and photographing agree.

Each file of a folder has one purpose only: to train, to select, to promise, or to reprint and evaluate. A rate at
places that training knows would say little about other places. A purpose with few files gets procedural places, too:
training a few, which it learns, a promise another for every session, because only many tell how much places differ. A
picture that the settings name itself is the known place for all purposes.

Procedural places are rooms, yards, roads and tables: a camera stands on a floor before walls or under a sky, among
boxes that have no class of their own; surfaces have the textures of `patterns`, light falls unevenly and distant things
are blurred. Every other place is one of the flat backgrounds of `patterns`, with details of other kinds.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from patchproof.base.color import codes_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, is_folder, open_image
from patchproof.base.resample import halving_pyramid
from patchproof.base.settings import BackgroundSettings
from patchproof.base.validation import expand_path
from patchproof.photo.read import allow_heic, list_images, read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene.patterns import background, color, texture

PLACE_PX = 256
_SEED = 20
_TEXTURE_PX = 128
_COLOR_SHARE = 0.6  # of a texture's color that remains: walls and floors are grayish
_SKY_DISTANCE = 1e6  # in units of the camera's height above the floor
MIN_CROP_SHARE = 0.6  # of the largest crop that fits
FEW_PICTURES = 10  # with fewer files than this, the scene notes that they are few
_FEW_NOTE = """only {} pictures in background.images: procedural places stand in for real ones; with {} or more, \
training and promise know different ones"""
# numbers of each purpose's procedural places
PLACE_NUMBERS = {"train": range(24), "select": range(1_000, 1_024)}
PLACE_NUMBERS |= {"promise": range(10_000, 20_000), "evaluate": range(20_000, 30_000)}
ENOUGH_FILES = 24  # training and selection with this many files need no procedural places
FILE_WEIGHT = 4  # with fewer, they see a file as often as this many procedural places
VIEWS_PER_FILE = 50  # other purposes see a file in one of this many views: a rate must not depend on two or three
# the purposes of files in the order of a hash of their names, repeated
_SPLIT_PATTERN = ("train", "promise", "evaluate", "select", "train", "promise", "train", "evaluate", "promise", "train")
CACHED_FILE_BYTES = 1 << 28  # of halvings: a view of 224 px needs 2 MB of one


def procedural_place(number: int) -> np.ndarray:
    """Return the place of a number, P×P×3 uint8, always the same for a number."""
    rng = np.random.default_rng([_SEED, number])
    return background(rng, PLACE_PX) if number % 2 else _room(rng, PLACE_PX)


def _room(rng: np.random.Generator, px: int) -> np.ndarray:
    """Render the view of a pinhole camera that stands one unit above a floor."""
    ray = _rays(rng, px)
    depth = np.full(ray.shape[1], _SKY_DISTANCE, np.float32)
    picture = (_paint(rng) * (1.2 - 0.5 * np.clip(ray[1, :, None], 0, 1))).astype(np.float32)
    planes = [(1, -1.0)]  # the floor, then walls: (axis, where it stands)
    if rng.random() < 0.7:
        planes += [(2, rng.uniform(1.5, 6)), (0, -rng.uniform(1.2, 6)), (0, rng.uniform(1.2, 6))]
    all_rays, slope = np.arange(ray.shape[1]), np.where(np.abs(ray) < 1e-9, np.float32(1e-9), ray)
    ahead = ray[:2] / slope[2]
    for axis, position in planes:
        _draw_plane(rng, picture, depth, ray, all_rays, position / slope[axis], axis)
    for _ in range(int(rng.integers(2, 12))):
        _draw_box(rng, picture, depth, ray, slope, ahead)
    light = rng.normal(size=3).astype(np.float32) * rng.uniform(0, 0.35) / 3
    lit = 1 + np.ascontiguousarray(np.clip(ray * np.minimum(depth, 5), -5, 5).T) @ light
    picture *= np.clip(lit, 0.25, 1.8)[:, None]
    picture = np.clip(picture, 0, 1).reshape(px, px, 3)
    return codes_from_srgb(cv2.GaussianBlur(picture, (0, 0), float(rng.choice([0.5, 0.8, 1.2, 2.5]))))


def _paint(rng: np.random.Generator) -> np.ndarray:
    """Return a grayish color, from nearly black to white."""
    strong, gray = color(rng), rng.uniform(0.08, 1)
    return np.clip(gray * (1 + _COLOR_SHARE * (strong - strong.mean())), 0, 1)


def _rays(rng: np.random.Generator, px: int) -> np.ndarray:
    """Return 3×P² directions by rows: x right, y up, z ahead, of a camera that looks down or up a little."""
    half, pitch, roll = np.tan(np.radians(rng.uniform(20, 35))), *np.radians(rng.normal(0, (12, 2)))
    y, x = (0.5 - (np.mgrid[:px, :px].reshape(2, -1) + 0.5) / px) * 2 * half
    x, y = -x * np.cos(roll) - y * np.sin(roll), -x * np.sin(roll) + y * np.cos(roll)
    return np.stack([x, y * np.cos(pitch) + np.sin(pitch), np.cos(pitch) - y * np.sin(pitch)]).astype(np.float32)


def _draw_plane(rng, picture, depth, ray, rays, distance, axis) -> None:
    """Draw a surface square to an axis, at `distance` along the `rays` (indices), in front of farther things."""
    paint, textured = _paint(rng), rng.random() < 0.7
    pattern = texture(rng, _TEXTURE_PX) if textured else np.ones((1, 1, 3))
    fineness = np.exp(rng.uniform(-1.5, 0.7))
    visible = (distance > 0) & (distance < depth[rays])
    if not visible.any():
        return
    rays, distance = rays[visible], distance[visible]
    if textured:
        pattern = pattern.mean(2, keepdims=True) * (1 - _COLOR_SHARE) + pattern * _COLOR_SHARE
    texels = ((0.3 + 0.7 * pattern) * paint).astype(np.float32).reshape(-1, 3)
    sides = (np.abs(ray[side, rays] * distance) for side in range(3) if side != axis)
    row, column = ((across * len(pattern) * fineness).astype(np.int64) % len(pattern) for across in sides)
    picture[rays] = texels[row * len(pattern) + column]
    depth[rays] = distance


def _draw_box(rng, picture, depth, ray, slope, ahead) -> None:
    """Draw a box on the floor: a ray meets it if it enters the last of its three slabs before it leaves the first."""
    size = np.exp(rng.uniform(-2.3, 0.3, 3))
    low = np.array([rng.uniform(-3, 3), -1.0, rng.uniform(1.2, 5)])
    ends = np.stack([low, low + size])
    rays = _candidate_rays(ahead, ends)
    slabs = ends.astype(np.float32)[..., None] / slope[:, rays]
    enter, leave = np.minimum(*slabs), np.maximum(*slabs)
    hit = np.flatnonzero(enter.max(0) < leave.min(0))
    face = enter[:, hit].argmax(0)
    for axis in range(3):
        on_axis = hit[face == axis]
        _draw_plane(rng, picture, depth, ray, rays[on_axis], enter[axis, on_axis], axis)


def _candidate_rays(ahead: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the rays that may meet a box ahead between points 2×3, by their position one unit ahead (2×P²)."""
    corners = ends[:, :2, None] / ends[:, 2]
    low, high = corners.min((0, 2)) - 1e-3, corners.max((0, 2)) + 1e-3
    return np.flatnonzero(((ahead > low[:, None]) & (ahead < high[:, None])).all(0))


class _Split(NamedTuple):
    """One purpose's pictures: `files` from number `first` on, then procedural `rooms`; `share` of views with files."""

    first: int
    files: int
    rooms: int
    share: float


class FileLevels:
    """A picture's file and its halvings, decoded as they come into use: a cache holds those that were used last."""

    def __init__(self, path: Path):
        self.path = path
        with _refuse_unreadable(path):
            allow_heic(path)
        with open_image(path, "a background picture", "remove or replace it"):
            pass  # what is no picture is refused before anything is computed

    @cached_property
    def shapes(self) -> list[tuple[int, int]]:
        """(height, width) of the picture and of its halvings."""
        return [level.shape[:2] for level in _decoded(self)]

    def __getitem__(self, number: int) -> np.ndarray:
        level = _file_levels.pop((self, number), None)
        _file_levels[self, number] = _decoded(self)[number] if level is None else level
        while len(_file_levels) > 1 and sum(each.nbytes for each in _file_levels.values()) > CACHED_FILE_BYTES:
            del _file_levels[next(iter(_file_levels))]  # the one that was used first
        return _file_levels[self, number]


_file_levels: dict[tuple[FileLevels, int], np.ndarray] = {}
_place_levels = lru_cache(192)(lambda number: halving_pyramid(procedural_place(number)))  # 0.3 MB, and 12 ms, each


@lru_cache(maxsize=1)
def _decoded(file: FileLevels) -> list[np.ndarray]:
    """All levels of the file that was decoded last."""
    with _refuse_unreadable(file.path):
        return halving_pyramid(read_photo(file.path).srgb)


@contextmanager
def _refuse_unreadable(path: Path) -> Iterator[None]:
    try:
        yield
    except PhotoRejected as rejection:
        got = f"{path.name} that cannot be read ({rejection.advice})"
        raise Refused("a background picture", got, "remove or replace it") from rejection


@dataclass(frozen=True)
class Backgrounds:
    """Background pictures: files, uint8 H×W×3, or numbers of procedural places; one 1×1 picture for a plain color."""

    pictures: tuple[np.ndarray | int | FileLevels, ...]
    of_stream: Mapping[str, _Split] = field(default_factory=dict)  # the pictures it may show; other streams show all
    notes: tuple[str, ...] = ()

    def choose_for_stream(self, stream: str, choice: np.ndarray) -> np.ndarray:
        """Turn numbers in [0, 1) that choose among a stream's pictures into numbers that choose among all pictures."""
        part = self.of_stream.get(stream, _Split(0, len(self.pictures), 0, 1.0))
        of_files = np.floor(choice / max(part.share, 1e-9) * part.files)
        of_rooms = part.files + np.floor((choice - part.share) / max(1 - part.share, 1e-9) * part.rooms)
        return (part.first + np.where(choice < part.share, of_files, of_rooms) + 0.5) / len(self.pictures)

    def picture(self, choice: np.ndarray, photo_px: tuple[int, int], size_px: tuple[int, int]) -> np.ndarray:
        """Return the background of a view of `size_px`: the whole photograph or, if square, its centered square."""
        levels = self.pictures[int(choice[0] * len(self.pictures))]
        if isinstance(levels, int):
            levels = _place_levels(levels)
        elif isinstance(levels, np.ndarray):
            levels = halving_pyramid(levels)
        shapes = levels.shapes if isinstance(levels, FileLevels) else [level.shape[:2] for level in levels]
        height, width = shapes[0]
        # a crop with the photograph's aspect
        largest = min(width / photo_px[0], height / photo_px[1])
        share = MIN_CROP_SHARE + (1 - MIN_CROP_SHARE) * choice[1]
        crop_w, crop_h = photo_px[0] * largest * share, photo_px[1] * largest * share
        x0, y0 = choice[2] * (width - crop_w), choice[3] * (height - crop_h)
        if size_px[0] == size_px[1]:
            side = min(crop_w, crop_h)
            x0, y0, crop_w, crop_h = x0 + (crop_w - side) / 2, y0 + (crop_h - side) / 2, side, side
        shrunk = levels[max(i for i in range(len(shapes)) if i == 0 or crop_w / 2**i >= size_px[0])]
        rows = _whole_pixels(y0 / height, crop_h / height, shrunk.shape[0])
        columns = _whole_pixels(x0 / width, crop_w / width, shrunk.shape[1])
        picture = cv2.resize(shrunk[rows, columns], size_px)  # a third of a warp's time
        return cv2.flip(picture, 1) if choice[4] < 0.5 else picture


def _whole_pixels(first: float, size: float, side_px: int) -> slice:
    """Return the pixels of a side that a crop takes, given as shares of the side."""
    size_px = max(1, round(size * side_px))
    first_px = min(round(first * side_px), side_px - size_px)
    return slice(first_px, first_px + size_px)


def load_backgrounds(settings: BackgroundSettings, base: Path) -> Backgrounds:
    """Load the scene's backgrounds; refused if the folder is missing or empty or a picture cannot be read."""
    if settings.color is not None:
        return Backgrounds((codes_from_srgb(np.array(settings.color)).reshape(1, 1, 3),))
    files = background_files(settings, base)
    if settings.images is not None and files in ([], [path := Path(expand_path(settings.images, base))]):
        if files:
            return Backgrounds((FileLevels(path),))
        do = "put some there or give a color"
        raise Refused("a folder of pictures (background.images)", f"no picture in {path}", do)
    return _split_by_purpose(files)


def background_files(settings: BackgroundSettings, base: Path) -> list[Path]:
    """List the pictures that the settings name: those in a folder, or a file; none without `images`."""
    if settings.images is None:
        return []
    path = Path(expand_path(settings.images, base))
    return [path] if is_file(path) else list_images(path) if is_folder(path) else []


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
        rooms = rooms if share < 1 else ()
        parts[name] = _Split(len(pictures), len(split_files), len(rooms), share)
        pictures += [*map(FileLevels, split_files), *rooms]
    notes = (_FEW_NOTE.format(len(files), FEW_PICTURES),) if 0 < len(files) < FEW_PICTURES else ()
    return Backgrounds(tuple(pictures), parts | {"reprint": parts["evaluate"]}, notes)
