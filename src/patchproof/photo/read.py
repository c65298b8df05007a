"""A photograph file as upright 8-bit sRGB pixels, with its focal length where the camera wrote one.

In: any still picture that Pillow reads as one of `FORMATS` (HEIC with the `heic` extra). Out: `Photo`. EXIF
orientation is applied, an embedded color profile (phones write Display P3) is converted to sRGB, alpha lies on
white, deeper channels become 8-bit. Whatever cannot be read raises `PhotoRejected("unreadable")`, and what takes more
than `limits` allow "too_costly", so that one bad file never stops a batch. Pixels are converted in strips, since whole
copies took twice the memory, and of more than `WHOLE_PX` every four become one: to measure takes up to 30 bytes each.
Whole JPEG files are decoded by OpenCV, which says on stderr what Pillow keeps to itself where their data are broken.
Ignored on purpose: the DPI that a photograph claims, and sidecar files.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.input import MAX_IMAGE_PX, is_file, is_folder, readable_formats
from patchproof.base.validation import summarize_names
from patchproof.photo.exif import EXIF_SPREAD, focal_of, is_part
from patchproof.photo.limits import MOST_BYTES, limited_memory, run_limited
from patchproof.photo.rejection import PhotoRejected

SUFFIXES = frozenset(".jpg .jpeg .jpe .png .tif .tiff .webp .bmp .gif .mpo .avif .heic .heif".split())
_ORIENTATION = 0x0112
# how the pixels of each orientation become upright ones (EXIF 2.32)
_UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a[::-1, ::-1].transpose(1, 0, 2),
    8: lambda a: np.rot90(a),
}
_STRIP_PX = 250_000  # a megabyte: larger ones leave the processor's cache, and take four times as long
WHOLE_PX = 30_000_000  # few cameras but phones give more; markers are looked for in 25 million at once
# What people copy along with photographs and nobody reads here.
_OTHERS = (
    (".mov .mp4 .m4v .avi .mkv .webm .3gp .mts", "videos, which are not looked at (take still photographs)"),
    (".dng .cr2 .cr3 .nef .arw .raf .orf .rw2 .pef .srw", "raw files, which are not looked at (save them as JPEG)"),
)
_TOO_DEEP = "folders in folders, which are not looked into (one folder for each session)"


@dataclass(frozen=True)
class Photo:
    """An upright photograph: uint8 H×W×3 sRGB, focal length in these pixels or None, the standard deviation of its
    logarithm, whether EXIF has one that does not fit this picture, and whether it is a crop or a screenshot as far as
    file and EXIF say.
    """

    srgb: np.ndarray
    focal_px: float | None
    focal_spread: float = EXIF_SPREAD
    cropped: bool = False
    part: bool = False


def read_photo(path: str | Path) -> Photo:
    """The photograph at `path`; `PhotoRejected` "unreadable" where there is none that can be read whole, "too_costly"
    where that would take too much.
    """
    path = Path(path)
    _allow_heic(path)
    try:
        with limited_memory():
            srgb, orientation, focal, part = run_limited(_stored, path)
            # of the picture as Pillow had it nothing is left by now
            return Photo(np.ascontiguousarray(_UPRIGHT.get(orientation, np.asarray)(srgb)), *focal, part)
    except PhotoRejected:
        raise
    except Exception as error:  # decoders fail in many ways (OSError, SyntaxError, struct.error...), all alike here
        if isinstance(error, MemoryError) or type(error).__name__ == "DecompressionBombError":
            raise _too_large("the picture takes too much memory: save it smaller") from error
        raise _unreadable(_why(path, error)) from error


def _stored(path: Path) -> tuple[np.ndarray, int, tuple[float | None, float, bool], bool]:
    """(uint8 sRGB H×W×3 as stored, EXIF orientation, what EXIF says of the focal length, whether it is a part): halved
    along both sides where there are too many pixels.
    """
    from PIL import Image

    if (size := path.stat().st_size) > MOST_BYTES:
        raise _too_large(f"a file of {size / 1e9:.1f} GB is too large: save it smaller", size, MOST_BYTES)
    with warnings.catch_warnings():
        # oversized pictures get our own limit below; odd EXIF is not worth a word
        warnings.simplefilter("ignore")
        with Image.open(path, formats=readable_formats()) as image:
            pixels = image.width * image.height
            if pixels > MAX_IMAGE_PX:
                raise _too_large(f"{pixels / 1e6:.0f} megapixels are too many: save it smaller", pixels, MAX_IMAGE_PX)
            step = 2 if pixels > WHOLE_PX and min(image.size) > 1 else 1
            (focal_px, spread, dropped), orientation = focal_of(image), image.getexif().get(_ORIENTATION, 1)
            focal, part = (focal_px and focal_px / step, spread, dropped), is_part(image, path.name)
            return _pixels(image, step), orientation if isinstance(orientation, int) else 1, focal, part


def list_photos(folder: str | Path) -> list[Path]:
    """The pictures of a folder by suffix, in the order of their names; refused where there are none."""
    folder = Path(folder)
    if is_file(folder):
        return [folder]
    if not is_folder(folder):
        raise Refused("a folder of photographs", f"no folder at {folder}", "check the path")
    paths = list_images(folder)
    if not paths:
        expected = f"photographs ({', '.join(sorted(SUFFIXES)[:6])}, ...) in {folder}"
        raise Refused(expected, "; ".join(["none", *list_skipped_files(folder)]), "copy the photographs there")
    return paths


def list_images(folder: Path) -> list[Path]:
    """The files of a folder that are pictures by their suffix, none hidden, in the order of their names."""
    files = (p for p in folder.iterdir() if is_file(p) and not p.name.startswith("."))
    return sorted((p for p in files if p.suffix.lower() in SUFFIXES), key=lambda p: p.name)


def list_skipped_files(folder: Path, without: Path | None = None) -> list[str]:
    """What lies in a folder and the folders in it that looks like evidence and is not read, in a sentence for each
    kind: videos and raw files without a picture of the same name, and pictures in folders deeper than that. The folder
    `without` is left out.
    """
    lost: dict[str, list[str]] = {}
    for parent, folders, files in os.walk(folder):
        inside = Path(parent).relative_to(folder)
        paths = [Path(name) for name in sorted(files) if not name.startswith(".")]
        stems = {path.stem for path in paths if path.suffix.lower() in SUFFIXES}
        if len(inside.parts) > 1:
            folders.clear()
            if stems:
                lost.setdefault(_TOO_DEEP, []).append(printable_name(str(inside)))
            continue
        folders[:] = sorted(f for f in folders if not f.startswith(".") and Path(parent, f).resolve() != without)
        for path in paths:
            kinds = (kind for suffixes, kind in _OTHERS if path.suffix.lower() in suffixes.split())
            if path.stem not in stems and (kind := next(kinds, None)):
                lost.setdefault(kind, []).append(printable_name(str(inside / path)))
    return [f"{kind}: {summarize_names(names)}" for kind, names in lost.items()]


def printable_name(name: str) -> str:
    """A file's name as text that can be written; what of its bytes is none is spelled out."""
    return name.encode("utf-8", "backslashreplace").decode()


def _allow_heic(path: Path) -> None:
    if path.suffix.lower() not in {".heic", ".heif"}:
        return
    try:
        import pillow_heif  # type: ignore[reportMissingImports]  # an extra
    except ImportError:
        advice = "HEIC needs pillow-heif: pip install 'patchproof[heic]', or save the photo as JPEG"
        raise _unreadable(advice) from None
    pillow_heif.register_heif_opener()


def _pixels(image, step: int) -> np.ndarray:
    """uint8 sRGB H×W×3 of an open picture, each the mean of `step` times `step`."""
    into_srgb = _into_srgb(image)
    if step == 1 and into_srgb is None and (whole := _whole_jpeg(image)) is not None:
        return whole
    image.load()
    if image.mode.startswith("I") or image.mode == "F":
        return np.repeat(_fewer(_of_deep_gray(image), step)[..., None], 3, axis=2)
    pixels = np.empty((image.height // step, image.width // step, 3), np.uint8)
    rows = max(1, _STRIP_PX // image.width // step)
    for top in range(0, len(pixels), rows):
        below = min(top + rows, len(pixels))
        strip = image.crop((0, step * top, image.width, step * below))
        strip = _opaque_rgb(strip if into_srgb is None else into_srgb(strip))
        pixels[top:below] = _fewer(np.asarray(strip), step)
    return pixels


def _whole_jpeg(image) -> np.ndarray | None:
    """uint8 H×W×3 of a JPEG in RGB, which OpenCV reads to the same bits in half the time; None of other files, and of
    one without an end, which only Pillow refuses.
    """
    if image.format != "JPEG" or image.mode != "RGB":
        return None
    data = np.fromfile(image.filename, np.uint8)
    if data[-2:].tobytes() != b"\xff\xd9":
        return None
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    return pixels if pixels is not None and pixels.shape == (image.height, image.width, 3) else None


def _fewer(pixels: np.ndarray, step: int) -> np.ndarray:
    """Means of `step` times `step` pixels; what is left over at the right and below is dropped."""
    height, width = (side // step for side in pixels.shape[:2])
    whole = pixels[: step * height, : step * width]
    return pixels if step == 1 else cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _into_srgb(image) -> Callable | None:
    """What converts the picture's parts from its embedded profile; None where there is none or it is broken."""
    from PIL import ImageCms

    profile = image.info.get("icc_profile")
    if not profile or image.mode not in {"RGB", "RGBA", "CMYK"}:
        return None
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return None
        into = "RGBA" if image.mode == "RGBA" else "RGB"  # alpha is carried over
        change = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), image.mode, into)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    return lambda part: ImageCms.applyTransform(part, change)


def _of_deep_gray(image) -> np.ndarray:
    """uint8 H×W."""
    values = np.asarray(image)
    if values.dtype.kind == "f":  # floating point TIFF counts from 0 to 1
        values = np.nan_to_num(values.astype(np.float32), posinf=1.0)
        top = max(1.0, float(values.max(initial=0)))
    else:  # 16-bit gray arrives as I;16 or I
        values, top = np.clip(values, 0, 65535).astype(np.uint16), 65535
    return cv2.convertScaleAbs(np.maximum(values, 0), alpha=255 / top)


def _opaque_rgb(image):
    if "transparency" in image.info or image.mode in {"RGBA", "LA", "PA", "La", "RGBa"}:
        from PIL import Image

        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return image if image.mode == "RGB" else image.convert("RGB")


def _why(path: Path, error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "the file is gone: copy it again"
    if type(error).__name__ == "UnidentifiedImageError":
        return f"{path.name} is not a picture of a known kind: save it as JPEG or PNG"
    return f"{path.name} is damaged or cut short: copy it again from the camera"


def _unreadable(advice: str) -> PhotoRejected:
    return PhotoRejected("unreadable", None, None, advice)


def _too_large(advice: str, figure: float | None = None, threshold: float | None = None) -> PhotoRejected:
    return PhotoRejected("too_costly", figure, threshold, advice)
