"""Read a photograph as upright 8-bit sRGB pixels, with its focal length if the camera wrote one.

In: any still picture that Pillow reads as one of `IMAGE_FORMATS` (HEIC with the `heic` extra). Out: `Photo`. EXIF
orientation is applied, an embedded color profile (phones write Display P3) is converted to sRGB, alpha is put on white,
deeper channels become 8-bit. A file that cannot be read raises `PhotoRejected("unreadable")`, one that exceeds `limits`
"too_costly", so that a bad file never stops a batch. Pixels are converted in strips, since whole copies take twice the
memory; above `WHOLE_PX` four pixels become one, since measuring takes up to 30 bytes each. Complete JPEG files are
decoded by OpenCV, which prints warnings about damaged data on stderr.
Ignored on purpose: the DPI that a photograph states, and sidecar files.
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
from patchproof.base.input import MAX_IMAGE_PX, is_file, is_folder, limit_memory, open_lazily
from patchproof.base.validation import summarize_names
from patchproof.photo.exif import EXIF_SPREAD, is_crop, read_focal
from patchproof.photo.limits import MOST_BYTES, run_limited
from patchproof.photo.rejection import PhotoRejected

SUFFIXES = frozenset(".jpg .jpeg .jpe .png .tif .tiff .webp .bmp .gif .mpo .avif .heic .heif".split())
_ORIENTATION = 0x0112
# the operation that makes the pixels of each orientation upright (EXIF 2.32)
_UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a[::-1, ::-1].transpose(1, 0, 2),
    8: lambda a: np.rot90(a),
}
_STRIP_PX = 250_000  # a megabyte: larger strips exceed the processor's cache, and take four times as long
WHOLE_PX = 30_000_000  # few cameras except phones give more; markers are searched in 25 million at once
# files that people copy together with photographs
_SKIPPED_KINDS = (
    (".mov .mp4 .m4v .avi .mkv .webm .3gp .mts", "videos, which are not read (take still photographs)"),
    (".dng .cr2 .cr3 .nef .arw .raf .orf .rw2 .pef .srw", "raw files, which are not read (save them as JPEG)"),
)
_TOO_DEEP = "folders in folders, which are not read (one folder for each session)"


@dataclass(frozen=True)
class Photo:
    """An upright photograph, uint8 H×W×3 sRGB."""

    srgb: np.ndarray
    focal_px: float | None
    focal_spread: float = EXIF_SPREAD  # standard deviation of the focal length's logarithm
    focal_rejected: bool = False  # EXIF has a focal length that does not fit this picture
    is_crop: bool = False  # a crop or a screenshot, as far as file name and EXIF tell


def read_photo(path: str | Path) -> Photo:
    """Read the photograph at `path`; raises `PhotoRejected("unreadable")` if it is missing or damaged, "too_costly" if
    it takes too much memory or time.
    """
    path = Path(path)
    _allow_heic(path)
    try:
        with limit_memory(MOST_BYTES):
            srgb, orientation, focal, crop = run_limited(_decode, path)
            # the memory of Pillow's picture has been freed by now
            return Photo(np.ascontiguousarray(_UPRIGHT.get(orientation, np.asarray)(srgb)), *focal, crop)
    except PhotoRejected:
        raise
    except Exception as error:  # decoders fail in many ways: OSError, SyntaxError, struct.error...
        if isinstance(error, MemoryError) or type(error).__name__ == "DecompressionBombError":
            raise _too_large("the picture takes too much memory: save it smaller") from error
        raise _unreadable(_advice(path, error)) from error


def _decode(path: Path) -> tuple[np.ndarray, int, tuple[float | None, float, bool], bool]:
    """(uint8 sRGB H×W×3 as stored, EXIF orientation, `read_focal`, `is_crop`); above `WHOLE_PX` at half size."""
    if (size := path.stat().st_size) > MOST_BYTES:
        raise _too_large(f"a file of {size / 1e9:.1f} GB is too large: save it smaller", size, MOST_BYTES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures, which have a limit below, and of unusual EXIF
        with open_lazily(path) as image:
            pixels = image.width * image.height
            if pixels > MAX_IMAGE_PX:
                raise _too_large(f"{pixels / 1e6:.0f} megapixels are too many: save it smaller", pixels, MAX_IMAGE_PX)
            step = 2 if pixels > WHOLE_PX and min(image.size) > 1 else 1
            (focal_px, spread, rejected), orientation = read_focal(image), image.getexif().get(_ORIENTATION, 1)
            focal, crop = (focal_px and focal_px / step, spread, rejected), is_crop(image, path.name)
            return _decode_pixels(image, step), orientation if isinstance(orientation, int) else 1, focal, crop


def list_photos(folder: str | Path) -> list[Path]:
    """The pictures of a folder in the order of their names, or `folder` itself if it is a file; refused without any."""
    folder = Path(folder)
    if is_file(folder):
        return [folder]
    if not is_folder(folder):
        raise Refused("a folder of photographs", f"no folder at {folder}", "check the path")
    paths = list_images(folder)
    if not paths:
        expected = f"photographs ({', '.join(sorted(SUFFIXES)[:6])}, ...) in {folder}"
        got = "; ".join(["none", *list_skipped_files(folder)])
        raise Refused(expected, got, "copy the photographs there")
    return paths


def list_images(folder: Path) -> list[Path]:
    """The files of a folder that have a picture's suffix and are not hidden, in the order of their names."""
    files = (p for p in folder.iterdir() if is_file(p) and not p.name.startswith("."))
    return sorted((p for p in files if p.suffix.lower() in SUFFIXES), key=lambda p: p.name)


def list_skipped_files(folder: Path, without: Path | None = None) -> list[str]:
    """Name the files in a folder and its subfolders that people may have meant as photographs but that are not read, a
    phrase for each kind: videos and raw files without a picture of the same name, and pictures in deeper folders. The
    folder `without` is not searched.
    """
    skipped: dict[str, list[str]] = {}
    for parent, folders, files in os.walk(folder):
        inside = Path(parent).relative_to(folder)
        paths = [Path(name) for name in sorted(files) if not name.startswith(".")]
        stems = {path.stem for path in paths if path.suffix.lower() in SUFFIXES}
        if len(inside.parts) > 1:
            folders.clear()
            if stems:
                skipped.setdefault(_TOO_DEEP, []).append(printable_name(str(inside)))
            continue
        folders[:] = sorted(f for f in folders if not f.startswith(".") and Path(parent, f).resolve() != without)
        for path in paths:
            kinds = (kind for suffixes, kind in _SKIPPED_KINDS if path.suffix.lower() in suffixes.split())
            if path.stem not in stems and (kind := next(kinds, None)):
                skipped.setdefault(kind, []).append(printable_name(str(inside / path)))
    return [f"{kind}: {summarize_names(names)}" for kind, names in skipped.items()]


def printable_name(name: str) -> str:
    """A file's name as valid text; bytes that are not UTF-8 are escaped."""
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


def _decode_pixels(image, step: int) -> np.ndarray:
    """uint8 sRGB H×W×3 of an open picture, each the mean of `step` × `step` pixels."""
    to_srgb = _profile_conversion(image)
    if step == 1 and to_srgb is None and (jpeg := _decode_jpeg(image)) is not None:
        return jpeg
    image.load()
    if image.mode.startswith("I") or image.mode == "F":
        return np.repeat(_average(_deep_gray(image), step)[..., None], 3, axis=2)
    pixels = np.empty((image.height // step, image.width // step, 3), np.uint8)
    rows = max(1, _STRIP_PX // image.width // step)
    for top in range(0, len(pixels), rows):
        bottom = min(top + rows, len(pixels))
        strip = image.crop((0, step * top, image.width, step * bottom))
        strip = _opaque_rgb(strip if to_srgb is None else to_srgb(strip))
        pixels[top:bottom] = _average(np.asarray(strip), step)
    return pixels


def _decode_jpeg(image) -> np.ndarray | None:
    """uint8 H×W×3 of an RGB JPEG, which OpenCV decodes to the same bits in half the time; None for other files, and for
    truncated ones, which only Pillow refuses.
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


def _average(pixels: np.ndarray, step: int) -> np.ndarray:
    """Means of `step` × `step` pixels; incomplete groups at the right and bottom are dropped."""
    height, width = (side // step for side in pixels.shape[:2])
    complete = pixels[: step * height, : step * width]
    return pixels if step == 1 else cv2.resize(complete, (width, height), interpolation=cv2.INTER_AREA)


def _profile_conversion(image) -> Callable | None:
    """A function that converts parts of the picture from its embedded profile to sRGB; None without a valid profile."""
    from PIL import ImageCms

    profile = image.info.get("icc_profile")
    if not profile or image.mode not in {"RGB", "RGBA", "CMYK"}:
        return None
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return None
        target_mode = "RGBA" if image.mode == "RGBA" else "RGB"  # alpha is preserved
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), image.mode, target_mode)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    return lambda part: ImageCms.applyTransform(part, transform)


def _deep_gray(image) -> np.ndarray:
    """uint8 H×W of a gray picture of more than 8 bits."""
    values = np.asarray(image)
    if values.dtype.kind == "f":  # floating-point TIFF ranges from 0 to 1
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


def _advice(path: Path, error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "the file is gone: copy it again"
    if type(error).__name__ == "UnidentifiedImageError":
        return f"{path.name} is not a picture of a known kind: save it as JPEG or PNG"
    return f"{path.name} is damaged or cut short: copy it again from the camera"


def _unreadable(advice: str) -> PhotoRejected:
    return PhotoRejected("unreadable", None, None, advice)


def _too_large(advice: str, figure: float | None = None, threshold: float | None = None) -> PhotoRejected:
    return PhotoRejected("too_costly", figure, threshold, advice)
