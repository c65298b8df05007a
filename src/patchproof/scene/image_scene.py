"""A scene of images: a piece at a random place, size and angle in pictures of its class, the classic 2D patch.

In: a folder of images and a CSV of file names and labels. Out: `ImageScene`. Only images of the target's class are
used: an assistive patch helps them, a deceptive one hides them. The whole printed piece lies inside the centered
square, turned by `view.roll_deg`, as large as `view.patch_share` says. In training, a random box of the picture below
it may be erased, so that the patch does not depend on one feature. White paper is sRGB white, and nothing else is
modeled: the promise holds for a patch pasted into such images, not for a print in the world. Training and selection see
one half of the images; promise, reprint and evaluation the other. A single image is used for all.

Sources: Brown et al., Adversarial Patch, 2017 (here also with the assistive goal); Zhong et al., Random Erasing Data
Augmentation, AAAI 2020, algorithm 1.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from patchproof.base.csv_file import read_csv
from patchproof.base.errors import Refused
from patchproof.base.fingerprint import files_sha256
from patchproof.base.geometry import rotated_extent
from patchproof.base.input import is_file
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import expand_path
from patchproof.photo.read import read_photo, summarize_said
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene import picture_scene
from patchproof.scene.conditions import Conditions, Stream
from patchproof.scene.interface import PX_PER_MODULE, READABLE_SHARE, SceneSource
from patchproof.scene.picture_scene import PictureLevels, PictureScene
from patchproof.sheets.markers import MARKER_MODULES
from patchproof.sheets.page import refuse_larger_than_page
from patchproof.sheets.piece import Piece, lay_out_piece, marker_size_mm
from patchproof.sheets.template import page_template

MIN_IMAGES_TO_SPLIT = 2
FEW_IMAGES = 20  # half of fewer images say little about other images
_OPTIMIZED_ON = {"train", "select"}
ERASED_AREA, ERASED_ASPECT = (0.02, 0.33), (0.3, 3.3)  # shares of the centered square; height over width
_HEADING_NAMES = {"file", "filename", "file_name", "image", "name"}
_ERASED_CELLS = 224  # random values per side of the centered square: one a pixel at networks' usual size


@dataclass(frozen=True)
class ImageScene(PictureScene):
    """A scene whose base pictures are images of the target's class, in an order that their names decide."""

    images: tuple[PictureLevels, ...]

    def description(self) -> str:
        """Return how many images there are."""
        return f"{len(self.images)} images"

    def _laid_out(self) -> Self:
        return replace(self, piece=_piece(self.settings, self.sheet_id))

    def draw(self, stream: Stream, n: int, seed: int | None = None, start: int = 0, per_session: int = 1) -> Conditions:
        """Draw from a stream, from its half of the images (`background[:, 0]`); only training erases (`[:, 4]` < 1)."""
        conditions = super().draw(stream, n, seed, start, per_session)
        background = conditions.pose.background.copy()
        if len(self.images) >= MIN_IMAGES_TO_SPLIT:
            middle = (len(self.images) // 2) / len(self.images)
            low, high = (0.0, middle) if stream in _OPTIMIZED_ON else (middle, 1.0)
            background[:, 0] = low + (high - low) * background[:, 0]
        if stream != "train":
            background[:, 4] = 1.0
        return replace(conditions, pose=replace(conditions.pose, background=background))

    def piece_homographies(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Return N×3×3 from piece millimeters to pixels."""
        to_size = picture_scene.size_from_photo(self.photo_px, size_px)
        side, photo, pose = min(self.photo_px), np.array(self.photo_px), conditions.pose
        # the piece's longer side takes the drawn share of the picture's shorter one
        (low, high), piece_mm = self.settings.view.patch_share, np.array(self.piece.size_mm)
        scales, matrices = low * (high / low) ** pose.background[:, 1] * side / piece_mm.max(), []
        for scale, roll, place in zip(scales, pose.roll_deg, pose.background[:, 2:4], strict=True):
            free_px = side - rotated_extent(piece_mm * scale, roll)
            middle = (photo - side) / 2 + side / 2 + (place - 0.5) * free_px
            matrices.append(to_size @ picture_scene.similarity_matrix(roll, scale, middle - piece_mm / 2, piece_mm / 2))
        return np.stack(matrices) @ picture_scene.print_scalings(self.piece, conditions)

    def pictures(self, conditions: Conditions, size_px: tuple[int, int]) -> np.ndarray:
        """Return N×H×W×3 uint8 sRGB: the images, some with a box of random values."""
        indices = picture_scene.pick_indices(conditions.pose.background[:, 0], len(self.images))
        pictures = [picture_scene.warp_picture(self.images[i], np.eye(3), self.photo_px, size_px) for i in indices]
        for picture, chance in zip(pictures, conditions.pose.background[:, 4], strict=True):
            if chance < self.settings.background.erasing:
                erase(picture, int(chance * 2**53))  # its digits: a view in other light has the same box
        return np.stack(pictures)

    def piece_light(self, conditions: Conditions) -> np.ndarray:
        """Return N×3×6 (see `PieceScene.piece_light`): 1 everywhere."""
        light = np.zeros((len(conditions), 3, 6))
        light[..., 0] = 1
        return light


def build(source: SceneSource) -> ImageScene:
    """Build the scene of a folder of images and their labels; warn about images that cannot be read. An image is the
    target's if its CSV label, or one of the comma-separated names in it, equals the target's name, its index, or a
    label in `target.accept`, ignoring case.
    """
    settings, base = source.settings, source.base
    picture_scene.refuse_bending(settings)
    files = _files_of_class(settings, base)
    images, unread, said = _read_all(files, settings.camera.photo_px)
    identity = source.sheet_id({})
    piece = _piece(settings, identity)
    warnings = [f"{name} is left out: it cannot be read" for name in unread] + said
    if len(images) < MIN_IMAGES_TO_SPLIT:
        warnings.append("the promise is made on the same image that the patch is optimized on")
    elif len(images) < FEW_IMAGES:
        half = len(images) - len(images) // 2
        warnings.append(f"the promise is made on {half} images, and says little of others: give {FEW_IMAGES} or more")
    inputs = {"object.images": files_sha256(files, whole=False)}
    return ImageScene(settings, base, source.seed, identity, piece, images, notes=tuple(warnings), inputs=inputs)


def largest_share(roll_deg: tuple[float, float]) -> float:
    """Return the largest `view.patch_share` that fits into the square at all angles, in whole thousandths."""
    widest = max(rotated_extent(np.ones(2), roll)[0] for roll in np.linspace(*roll_deg))  # of a turned square of side 1
    return int(1000 / widest) / 1000


def erase(picture: np.ndarray, seed: int) -> None:
    """Apply Random Erasing to a uint8 H×W×3 picture in place: a box of its centered square takes random values, the
    same box and values at every size, in photograph and square.
    """
    rng = np.random.default_rng(seed)
    left = top = wide = high = 1.0
    while left + wide > 1 or top + high > 1:  # boxes that do not fit are drawn again, as in the paper
        area, aspect = rng.uniform(*ERASED_AREA), rng.uniform(*ERASED_ASPECT)
        high, wide = np.sqrt(area * aspect), np.sqrt(area / aspect)
        left, top = rng.random(2)
    values = rng.integers(0, 256, (_ERASED_CELLS, _ERASED_CELLS, 3), np.uint8)
    height, width = picture.shape[:2]
    side = min(height, width)
    x, y = ((np.arange(n) + 0.5 - (n - side) / 2) / side for n in (width, height))
    columns = np.flatnonzero((x >= left) & (x < left + wide))
    rows = np.flatnonzero((y >= top) & (y < top + high))
    cell_x, cell_y = ((v * _ERASED_CELLS).astype(int) for v in (x[columns], y[rows]))
    picture[np.ix_(rows, columns)] = values[np.ix_(cell_y, cell_x)]


def _files_of_class(settings: SceneSettings, base: Path) -> list[Path]:
    """Return the files with the target's label, in an order that depends on nothing but their names."""
    names = (settings.object.images or "", settings.object.labels or "")
    folder, table = (Path(expand_path(name, base)) for name in names)
    rows = read_labels(table, folder)
    target = settings.target
    labels = {str(label).strip().casefold() for label in (target.label, *target.accept)}
    file_names = [name for name, label in rows if labels & {label, *(part.strip() for part in label.split(","))}]
    if not file_names:
        others = ", ".join(sorted({label for _, label in rows})[:5])
        got = f"{len(rows)} images with other labels ({others} ...)"
        remedy = "give the target the name or index that it has in this file"
        if isinstance(target.label, str) and all(label.isdigit() for _, label in rows):
            remedy = f'write the index of "{target.label}" as target.label, because this file has indices'
        raise Refused(f'images labeled "{target.label}" in {table}', got, remedy)
    missing = [name for name in file_names if not is_file(folder / name)]
    if missing:
        got = f"{len(missing)} missing ({missing[0]})"
        raise Refused(f"the images that {table.name} names in {folder}", got, "copy them there")
    return [folder / name for name in sorted(set(file_names), key=lambda name: hashlib.sha256(name.encode()).digest())]


def read_labels(table: Path, folder: Path) -> list[tuple[str, str]]:
    """Return (name in `folder`, label in small letters) of each line but a heading; later commas are the label's."""
    rows = read_csv(table, "a CSV of file names and labels (object.labels)")
    short = next((row for row in rows if len(row) < 2), None)
    if short is not None:
        raise Refused(f"a file name and a label in each line of {table}", f'"{short[0]}"', "add the label")
    first = rows[0][0].strip() if rows else ""
    rows = rows[first.casefold() in _HEADING_NAMES and not is_file(folder / first) :]
    return [(row[0].strip(), ",".join(row[1:]).strip().casefold()) for row in rows]


def _read_all(files: list[Path], photo_px: tuple[int, int]) -> tuple[tuple[PictureLevels, ...], list[str], list[str]]:
    """(pictures, names of unreadable files, what files declare and was left aside)."""
    images, unread, said = [], [], []
    for path in files:
        try:
            photo = read_photo(path)
            images.append(picture_scene.picture_for(photo.srgb, photo_px)[0])
            said.append((path.name, photo.said))
        except PhotoRejected:
            unread.append(path.name)
    if not images:
        got = f"{len(files)} unreadable in {files[0].parent}"
        raise Refused("an image that can be read", got, "save them as JPEG or PNG")
    return tuple(images), unread, summarize_said(said)


def _piece(settings: SceneSettings, identity: str) -> Piece:
    """Lay out the printed piece with markers as large as the views need them."""
    (low, high), size_mm, template = settings.view.patch_share, settings.patch.size_mm, settings.sheet.template
    if low <= 0:
        raise Refused("view.patch_share above 0", f"{low:g}", "give a share between 0 and 1")
    largest = largest_share(settings.view.roll_deg)
    if high > largest:
        expected = "a piece that fits into the picture's centered square at the largest view.patch_share"
        raise Refused(expected, f"{high:g}, which is {high / largest:.0%} of what fits", f"lower it to {largest:g}")
    smallest = low * (high / low) ** (1 - READABLE_SHARE)
    needed_mm = MARKER_MODULES * PX_PER_MODULE * max(size_mm) / (smallest * min(settings.camera.photo_px))
    marker_mm = marker_size_mm(needed_mm, size_mm) if settings.sheet.markers else 0.0
    piece = lay_out_piece(size_mm, marker_mm, identity, "design")
    refuse_larger_than_page(page_template(template), piece)
    return piece
