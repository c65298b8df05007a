"""A photograph file as upright 8-bit sRGB pixels, with its focal length where the camera wrote one.

In: any still picture that Pillow reads as one of `FORMATS` (HEIC with the `heic` extra). Out: `Photo`. EXIF
orientation is applied, an embedded color profile (phones write Display P3) is converted to sRGB, alpha lies on
white, deeper channels become 8-bit. Whatever cannot be read raises `CannotJudge("unreadable")`, so that one bad file
never stops a batch. Ignored on purpose: the DPI that a photograph claims, and sidecar files.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from patchproof.photo.cannot import CannotJudge
from patchproof.photo.exif import EXIF_SPREAD, focal_of
from patchproof.strict import Refused

SUFFIXES = frozenset(".jpg .jpeg .jpe .png .tif .tiff .webp .bmp .gif .mpo .avif .heic .heif".split())
# an allow-list, because Pillow also opens formats that start other programs (EPS) or hold no photograph
FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "AVIF", "HEIF")
LARGEST_PX = 120_000_000  # 360 MB as pixels; the largest phone sensors in common use give 50 to 108 million
_ORIENTATION = 0x0112


@dataclass(frozen=True)
class Photo:
    """An upright photograph: uint8 H×W×3 sRGB, focal length in its own pixels or None, the standard deviation of its
    logarithm, and whether EXIF has one that does not fit this picture.
    """

    srgb: np.ndarray
    focal_px: float | None
    focal_spread: float = EXIF_SPREAD
    cropped: bool = False


def read_photo(path: str | Path) -> Photo:
    """The photograph at `path`; `CannotJudge("unreadable")` where there is none that can be read whole."""
    from PIL import Image, ImageOps

    path = Path(path)
    _allow_heic(path)
    try:
        with warnings.catch_warnings():
            # oversized pictures get our own limit below; odd EXIF is not worth a word
            warnings.simplefilter("ignore")
            with Image.open(path, formats=readable_formats()) as image:
                pixels = image.width * image.height
                if pixels > LARGEST_PX:
                    advice = f"{pixels / 1e6:.0f} megapixels are too many: save it smaller"
                    raise _unreadable(advice, pixels, LARGEST_PX)
                focal = focal_of(image)
                # turning and converting copy the picture, which for most is not needed and takes as long as decoding
                turned = image.getexif().get(_ORIENTATION, 1) != 1
                upright = ImageOps.exif_transpose(image) if turned else image
                srgb = np.ascontiguousarray(_eight_bit_rgb(_in_srgb(upright)))
    except CannotJudge:
        raise
    except Exception as error:  # decoders fail in many ways (OSError, SyntaxError, struct.error...), all alike here
        raise _unreadable(_why(path, error)) from error
    return Photo(srgb, *focal)


def list_photos(folder: str | Path) -> list[Path]:
    """The pictures of a folder by suffix, in the order of their names; refused where there are none."""
    folder = Path(folder)
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise Refused("a folder of photographs", f"no folder at {folder}", "check the path")
    paths = pictures_in(folder)
    if not paths:
        expected = f"photographs ({', '.join(sorted(SUFFIXES)[:6])}, ...) in {folder}"
        raise Refused(expected, "none", "copy the photographs there")
    return paths


def pictures_in(folder: Path) -> list[Path]:
    """The files of a folder that are pictures by their suffix, none hidden, in the order of their names."""
    files = (p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    return sorted((p for p in files if p.suffix.lower() in SUFFIXES), key=lambda p: p.name)


def readable_formats() -> list[str]:
    """Those of `FORMATS` that this Pillow reads."""
    from PIL import Image

    Image.init()
    return [name for name in FORMATS if name in Image.OPEN]


def _allow_heic(path: Path) -> None:
    if path.suffix.lower() not in {".heic", ".heif"}:
        return
    try:
        import pillow_heif  # type: ignore[reportMissingImports]  # an extra
    except ImportError:
        advice = "HEIC needs pillow-heif: pip install 'patchproof[heic]', or save the photo as JPEG"
        raise _unreadable(advice) from None
    pillow_heif.register_heif_opener()


def _in_srgb(image):
    """The picture converted from its embedded profile; as it is where there is none or the profile is broken."""
    from PIL import ImageCms

    profile = image.info.get("icc_profile")
    if not profile or image.mode not in {"RGB", "CMYK"}:
        return image
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return image
        return ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError):
        return image


def _eight_bit_rgb(image) -> np.ndarray:
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image)
        if values.dtype.kind == "f":  # floating point TIFF counts from 0 to 1
            values = np.nan_to_num(values.astype(np.float32), posinf=1.0)
            top = max(1.0, float(values.max(initial=0)))
        else:  # 16-bit gray arrives as I;16 or I
            values, top = np.clip(values, 0, 65535).astype(np.uint16), 65535
        gray = cv2.convertScaleAbs(np.maximum(values, 0), alpha=255 / top)
        return np.repeat(gray[..., None], 3, axis=2)
    if "transparency" in image.info or image.mode in {"RGBA", "LA", "PA", "La", "RGBa"}:
        from PIL import Image

        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


def _why(path: Path, error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "the file is gone: copy it again"
    if isinstance(error, MemoryError) or type(error).__name__ == "DecompressionBombError":
        return "the picture is too large: save it smaller"
    if type(error).__name__ == "UnidentifiedImageError":
        return f"{path.name} is not a picture of a known kind: save it as JPEG or PNG"
    return f"{path.name} is damaged or cut short: copy it again from the camera"


def _unreadable(advice: str, figure: float | None = None, threshold: float | None = None) -> CannotJudge:
    return CannotJudge("unreadable", figure, threshold, advice)
