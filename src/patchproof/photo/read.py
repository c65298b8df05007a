"""Read a photograph as upright 8-bit sRGB pixels, with its focal length if the camera wrote one.

In: any still picture that Pillow reads as one of `IMAGE_FORMATS` (HEIC with the `heic` extra). Out: `Photo`.
Orientation is applied once, the color space that the file declares is converted to sRGB, alpha is put on white, deeper
channels become 8-bit; `declarations` lists all that files can declare, and `Photo.said` what was left aside. A file
that cannot be read, or not all of it, raises `PhotoRejected("unreadable")`, one that exceeds `limits` "too_costly", so
that a bad file never stops a batch. Pixels are converted in strips, since whole copies take twice the memory; above
`WHOLE_PX` four pixels become one, since measuring takes up to 30 bytes each.
Ignored on purpose: sidecar files, dates and places, what a camera's maker notes say of its lens.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.input import MAX_IMAGE_PX, is_file, is_folder, limit_memory, open_lazily
from patchproof.base.text import printable
from patchproof.base.validation import summarize_names
from patchproof.photo.color_space import SRGB_PRIMARIES, ColorSpace, color_space, eight_bits, rgb_space
from patchproof.photo.deep_codes import deep_codes
from patchproof.photo.exif import EXIF_SPREAD, exif_tags, is_crop, read_focal
from patchproof.photo.jpeg import decode_jpeg
from patchproof.photo.limits import MOST_BYTES, run_limited
from patchproof.photo.rejection import PhotoRejected

SUFFIXES = frozenset(".jpg .jpeg .jpe .png .tif .tiff .webp .bmp .gif .mpo .avif .heic .heif".split())
_ORIENTATION, _XMP_ORIENTATION = 0x0112, re.compile(rb"tiff:Orientation\s*(?:=\s*[\"']|>)\s*([1-8])")
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
    (".pdf .jxl .jp2 .psd", "files of other kinds, which are not read (save each page as JPEG or PNG)"),
)
TWO_ORIENTATIONS = "orientations in XMP that contradict EXIF's, which is used"
MORE_PAGES = "pages or pictures after the first in a file, which are not read (save each as a file of its own)"
GAIN_MAP = "gain maps for HDR screens, which are not applied"
EXTRA_CHANNELS = "extra channels that are neither color nor transparency"
_GAIN_MAPS = (b"hdrgm:Version", b"iso:ts:21496:-1", b"hdrgainmap")  # Adobe's and Android's, ISO's, a phone maker's
_HEAD_BYTES, _EXTRA_SAMPLES = 1 << 16, 338
_TOO_DEEP = "folders in folders, which are not read (one folder for each session)"


@dataclass(frozen=True)
class Photo:
    """An upright photograph, uint8 H×W×3 sRGB."""

    srgb: np.ndarray
    focal_px: float | None
    focal_spread: float = EXIF_SPREAD  # standard deviation of the focal length's logarithm
    focal_rejected: bool = False  # EXIF has a focal length that does not fit this picture
    is_crop: bool = False  # a crop or a screenshot, as far as file name and EXIF tell
    dpi: tuple[float, ...] = ()  # (x, y) as the file states it, for scans; 0 or empty if it does not
    said: tuple[str, ...] = ()  # what the file declares and is left aside, a phrase for each kind


def read_photo(path: str | Path) -> Photo:
    """Read the photograph at `path`; raises `PhotoRejected("unreadable")` if it is missing or damaged, "too_costly" if
    it takes too much memory or time.
    """
    path = Path(path)
    allow_heic(path)
    try:
        with limit_memory(MOST_BYTES):
            srgb, orientation, fields = run_limited(_decode, path)
            # the memory of Pillow's picture has been freed by now
            return Photo(np.ascontiguousarray(_UPRIGHT.get(orientation, np.asarray)(srgb)), **fields)
    except PhotoRejected:
        raise
    except Exception as error:  # decoders fail in many ways: OSError, SyntaxError, struct.error...
        if isinstance(error, MemoryError) or type(error).__name__ == "DecompressionBombError":
            raise _too_large("the picture takes too much memory: save it smaller") from error
        raise _unreadable(_advice(path, error)) from error


def _decode(path: Path) -> tuple[np.ndarray, int, dict[str, Any]]:
    """(uint8 sRGB H×W×3 as stored, orientation, the other fields of `Photo`); above `WHOLE_PX` at half size."""
    if (size := path.stat().st_size) > MOST_BYTES:
        raise _too_large(f"a file of {size / 1e9:.1f} GB is too large: save it smaller", size, MOST_BYTES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures, which have a limit below, and of unusual EXIF
        with open_lazily(path) as image:
            pixels = image.width * image.height
            if pixels > MAX_IMAGE_PX:
                raise _too_large(f"{pixels / 1e6:.0f} megapixels are too many: save it smaller", pixels, MAX_IMAGE_PX)
            step = 2 if pixels > WHOLE_PX and min(image.size) > 1 else 1
            focal_px, spread, rejected = read_focal(image)
            fields = {"focal_px": focal_px and focal_px / step, "focal_spread": spread, "focal_rejected": rejected}
            dpi = tuple(float(each) for each in np.ravel(image.info.get("dpi", ())))
            fields |= {"is_crop": is_crop(image, path.name), "dpi": dpi}
            (orientation, contradiction), rest = _orientation(image), _left_aside(image)
            srgb, said = _decode_pixels(image, path, step)
            return srgb, orientation, fields | {"said": (*contradiction, *rest, *said)}


def _orientation(image) -> tuple[int, tuple[str, ...]]:
    """The stored pixels' orientation (1: upright), and whether EXIF and XMP contradict each other. Pillow and OpenCV
    turn TIFFs themselves; Pillow takes XMP's where EXIF has none, and gives that of AVIF's boxes as EXIF.
    """
    if image.format in ("AVIF", "HEIF") and "exif" not in image.info:
        return 1, ()
    xmp = image.info.get("xmp") or b""
    stated = _XMP_ORIENTATION.search(xmp if isinstance(xmp, bytes) else xmp.encode())
    orientation = exif_tags(image).get(_ORIENTATION, int(stated[1]) if stated else 1)
    said = (TWO_ORIENTATIONS,) if stated and int(stated[1]) != orientation else ()
    return orientation if isinstance(orientation, int) and image.format != "TIFF" else 1, said


def _left_aside(image) -> tuple[str, ...]:
    """What else is in a file besides the picture that is read."""
    said = []
    with open(image.filename, "rb") as file:
        head = file.read(-1 if image.format == "MPO" else _HEAD_BYTES)
    if any(name in head for name in _GAIN_MAPS):
        said.append(GAIN_MAP)
    elif image.format == "MPO":
        kinds = [entry["Attribute"]["MPType"] for entry in image.mpinfo[0xB002][1:]]
        said += [MORE_PAGES] if any(not kind.startswith("Large Thumbnail") for kind in kinds) else []
    elif getattr(image, "is_animated", False):
        said.append(MORE_PAGES)
    if 0 in np.atleast_1d(getattr(image, "tag_v2", {}).get(_EXTRA_SAMPLES, 1)):
        said.append(EXTRA_CHANNELS)
    return tuple(said)


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


def list_skipped_files(folder: Path, without: Path | None = None, depth: int = 1) -> list[str]:
    """Name the files in a folder and its subfolders that people may have meant as photographs but that are not read, a
    phrase for each kind: videos and raw files without a picture of the same name, and pictures in folders deeper than
    `depth`. The folder `without` is not searched.
    """
    skipped: dict[str, list[str]] = {}
    for parent, folders, files in os.walk(folder):
        inside = Path(parent).relative_to(folder)
        paths = [Path(name) for name in sorted(files) if not name.startswith(".")]
        stems = {path.stem for path in paths if path.suffix.lower() in SUFFIXES}
        if len(inside.parts) > depth:
            folders.clear()
            if stems:
                skipped.setdefault(_TOO_DEEP, []).append(printable(str(inside)))
            continue
        folders[:] = sorted(f for f in folders if not f.startswith(".") and Path(parent, f).resolve() != without)
        for path in paths:
            kinds = (kind for suffixes, kind in _SKIPPED_KINDS if path.suffix.lower() in suffixes.split())
            if path.stem not in stems and (kind := next(kinds, None)):
                skipped.setdefault(kind, []).append(printable(str(inside / path)))
    return [f"{kind}: {summarize_names(names)}" for kind, names in skipped.items()]


def summarize_said(said: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Sum up what files of these names declare and was left aside (`Photo.said`): a phrase for each kind."""
    names: dict[str, list[str]] = {}
    for name, phrases in said:
        for phrase in phrases:
            names.setdefault(phrase, []).append(name)
    return [f"{phrase}: {summarize_names(files)}" for phrase, files in names.items()]


def allow_heic(path: Path) -> None:
    """Let Pillow open HEIC files, if this is one; raises `PhotoRejected` without the library for it."""
    if path.suffix.lower() not in {".heic", ".heif"}:
        return
    try:
        import pillow_heif  # type: ignore[reportMissingImports]  # an extra
    except ImportError:
        advice = "HEIC needs pillow-heif: pip install 'patchproof[heic]', or save the photo as JPEG"
        raise _unreadable(advice) from None
    pillow_heif.register_heif_opener()


def _decode_pixels(image, path: Path, step: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """uint8 sRGB H×W×3 of an open picture, each the mean of `step` × `step` pixels, and what is left aside of it."""
    from PIL import ImageChops

    space, said = color_space(image)
    codes = _jpeg_codes(image, path)
    if codes is None:
        image.load()
        if image.mode == "CMYK" and image.format == "JPEG" and "adobe" not in image.info:
            image = ImageChops.invert(image)  # Pillow takes the inks of every JPEG as Adobe's, which are inverted
        if (deep := deep_codes(image, path)) is not None:
            codes, space = deep[0], rgb_space(SRGB_PRIMARIES, None, 1.0) if image.mode == "F" else space
            said += (deep[1],) if deep[1] else ()
    if codes is not None and codes.dtype == np.uint8 and space is None and step == 1:
        return codes, said
    width, height = image.size if codes is None else codes.shape[1::-1]
    pixels = np.empty((height // step, width // step, 3), np.uint8)
    rows = max(1, _STRIP_PX // width // step)
    for top in range(0, len(pixels), rows):
        bottom = min(top + rows, len(pixels))
        if codes is None:
            strip = _opaque_srgb(image.crop((0, step * top, width, step * bottom)), space)
        else:
            part = codes[step * top : step * bottom]
            strip = eight_bits(part) if space is None else space.to_srgb(part)
        pixels[top:bottom] = _average(strip, step)
    return pixels, said


def _jpeg_codes(image, path: Path) -> np.ndarray | None:
    """uint8 H×W×3 of a JPEG, which OpenCV decodes to the same bits in half the time; None for inks, other files, and
    truncated ones, which Pillow refuses.
    """
    if image.format not in ("JPEG", "MPO"):
        return None
    inks = image.mode not in ("RGB", "L")
    pixels = decode_jpeg(path.read_bytes(), cv2.IMREAD_REDUCED_COLOR_8 if inks else cv2.IMREAD_COLOR_RGB)
    return None if inks or pixels is None or pixels.shape[1::-1] != image.size else pixels


def _average(pixels: np.ndarray, step: int) -> np.ndarray:
    """Means of `step` × `step` pixels; incomplete groups at the right and bottom are dropped."""
    height, width = (side // step for side in pixels.shape[:2])
    complete = pixels[: step * height, : step * width]
    return pixels if step == 1 else cv2.resize(complete, (width, height), interpolation=cv2.INTER_AREA)


def _opaque_srgb(image, space: ColorSpace | None) -> np.ndarray:
    """uint8 sRGB H×W×3 of a part of a picture, on white where it is transparent."""
    from PIL import Image

    if image.mode == "La":  # Pillow converts it to nothing else
        image = image.convert("LA")
    alpha = None
    if "transparency" in image.info or image.mode in {"RGBA", "LA", "PA", "RGBa"}:
        image = image.convert("RGBA")
        alpha = image.getchannel("A")
    colors = image.convert("RGB" if space is None else space.mode)
    if space is not None:
        colors = Image.fromarray(space.to_srgb(np.asarray(colors)))
    if alpha is not None:
        colors.putalpha(alpha)
        colors = Image.alpha_composite(Image.new("RGBA", image.size, "white"), colors).convert("RGB")
    return np.asarray(colors)


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
