"""Pictures behind the object: a folder of photographs or one plain color.

In: the folder and, per view, five numbers in [0, 1) that choose picture, crop and mirroring. Out: H×W×3 uint8 sRGB. The
photograph and its centered square show the same crop, so that what trains and what is photographed agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from patchproof.color import codes_of
from patchproof.settings import BackgroundSettings
from patchproof.strict import Refused, expand

SMALLEST_CROP = 0.6  # of the largest crop that fits
_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"}
_PLAIN = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Backgrounds:
    """Pictures as uint8 H×W×3, or a single 1×1 picture where the background is plain."""

    pictures: tuple[np.ndarray, ...]

    @cached_property
    def _reduced(self) -> tuple[list[np.ndarray], ...]:
        """Each picture with its halvings, so that a small view does not read megapixels."""
        import cv2

        pyramids = []
        for picture in self.pictures:
            levels = [picture]
            while min(levels[-1].shape[:2]) >= 256:
                height, width = levels[-1].shape[:2]
                levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
            pyramids.append(levels)
        return tuple(pyramids)

    def picture(self, choice: np.ndarray, photo_px: tuple[int, int], size_px: tuple[int, int]) -> np.ndarray:
        """What lies behind one view of `size_px`: the whole photograph, or its centered square where `size_px` is
        square.
        """
        import cv2

        levels = self._reduced[int(choice[0] * len(self.pictures))]
        height, width = levels[0].shape[:2]
        x0, y0, crop_w, crop_h = _crop((width, height), choice, photo_px)
        if size_px[0] == size_px[1]:
            side = min(crop_w, crop_h)
            x0, y0, crop_w, crop_h = x0 + (crop_w - side) / 2, y0 + (crop_h - side) / 2, side, side
        level = 0
        while level + 1 < len(levels) and crop_w / 2 ** (level + 1) >= size_px[0]:
            level += 1
        shrunk = levels[level]
        sx, sy = shrunk.shape[1] / width, shrunk.shape[0] / height
        scale_x, scale_y = crop_w * sx / size_px[0], crop_h * sy / size_px[1]
        # pixel centers at .5 on both sides
        matrix = np.array([[scale_x, 0, x0 * sx + scale_x / 2 - 0.5], [0, scale_y, y0 * sy + scale_y / 2 - 0.5]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        picture = cv2.warpAffine(shrunk, matrix, size_px, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return picture[:, ::-1] if choice[4] < 0.5 else picture


def load_backgrounds(settings: BackgroundSettings, base: Path) -> Backgrounds:
    """The scene's backgrounds; refused where the folder is missing, empty, or holds a picture that cannot be read."""
    if settings.images is None:
        plain = codes_of(np.array(settings.color or _PLAIN))
        return Backgrounds((plain.reshape(1, 1, 3),))
    folder = Path(expand(settings.images, base))
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES) if folder.is_dir() else []
    if not files:
        raise Refused(
            "a folder of pictures (background.images)", f"none in {folder}", "put photographs there or give a color"
        )
    return Backgrounds(tuple(_read(file) for file in files))


def _read(file: Path) -> np.ndarray:
    from PIL import Image, ImageOps

    try:
        with Image.open(file) as image:
            return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise Refused("a background picture", f"{file} that cannot be read", "remove or replace it") from error


def _crop(
    picture_px: tuple[int, int], choice: np.ndarray, photo_px: tuple[int, int]
) -> tuple[float, float, float, float]:
    """x, y, width, height of a crop with the photograph's aspect."""
    width, height = picture_px
    largest = min(width / photo_px[0], height / photo_px[1])
    share = SMALLEST_CROP + (1 - SMALLEST_CROP) * choice[1]
    crop_w, crop_h = photo_px[0] * largest * share, photo_px[1] * largest * share
    return choice[2] * (width - crop_w), choice[3] * (height - crop_h), crop_w, crop_h
