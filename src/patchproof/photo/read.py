"""Read a photograph as upright 8-bit sRGB pixels, with its focal length if the camera wrote one.

In: any still picture that Pillow reads as one of `IMAGE_FORMATS` (HEIC with the `heic` extra). Out: `Photo`, or
`PhotoRejected`, so that a bad file never stops a batch. `declarations.csv` lists what files can declare: colors become
sRGB, alpha is put on white, deeper channels become 8-bit. Pixels are converted in strips, since whole copies take twice
the memory; above `WHOLE_PX` four pixels become one, since measuring takes up to 30 bytes each.
JPEGs are decoded by OpenCV, strictly: what libjpeg warns of is damage. It fills that with gray or wrong blocks and says
so on stderr alone, which is read meanwhile. It says only one thing of a file: where that is an odd header, what follows
is decoded again under a plain one. Zeroed bytes may decode without a warning: a run of them is damage if the code of
zeros is not that of a flat block, where one scan holds all (chroma alone, or a progressive file, may be flat). Bytes
that change within one block leave no trace.
Ignored on purpose: sidecar files, dates and places, what a camera's maker notes say of its lens.
"""

import os
import re
import tempfile
import threading
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.input import MAX_IMAGE_PX, is_file, is_folder, limit_memory, open_lazily
from patchproof.base.text import printable
from patchproof.base.validation import summarize_names
from patchproof.photo.exif import EXIF_IFD, EXIF_SPREAD, exif_tags, is_crop, read_focal
from patchproof.photo.limits import MOST_BYTES, run_limited
from patchproof.photo.rejection import PhotoRejected

if TYPE_CHECKING:
    from patchproof.photo.color_space import ColorSpace

SUFFIXES = frozenset(".jpg .jpeg .jpe .png .tif .tiff .webp .bmp .gif .mpo .avif .heic .heif".split())
_ORIENTATION, _XMP_ORIENTATION = 0x0112, re.compile(rb"tiff:Orientation\s*(?:=\s*[\"']|>)\s*([1-8])")
_STRIP_PX = 250_000  # a megabyte: larger strips exceed the processor's cache, and take four times as long
HEIC_ADVICE = "HEIC needs pillow-heif: pip install 'patchproof[heic]', or save the photo as JPEG"
GONE_ADVICE = "the file is gone: copy it again"
WHOLE_PX = 30_000_000  # few cameras except phones give more; markers are searched in 25 million at once
_SKIPPED = (  # files that people copy together with photographs
    (".mov .mp4 .m4v .avi .mkv .webm .3gp .mts", "videos, which are not read (take still photographs)"),
    (".dng .cr2 .cr3 .nef .arw .raf .orf .rw2 .pef .srw", "raw files, which are not read (save them as JPEG)"),
    (".zip .rar .7z .tar .gz .tgz", "archives, which are not read (unpack them)"),
    (".pdf .jxl .jp2 .psd", "files of other kinds, which are not read (save each page as JPEG or PNG)"),
)
_SKIPPED_KINDS = {suffix: kind for suffixes, kind in _SKIPPED for suffix in suffixes.split()}
TWO_ORIENTATIONS = "orientations in XMP that contradict EXIF's, which is used"
MORE_PAGES = "pages or pictures after the first in a file, which are not read (save each as a file of its own)"
GAIN_MAP = "gain maps for HDR screens, which are not applied"
EXTRA_CHANNELS = "extra channels that are neither color nor transparency"
_GAIN_MAPS = (b"hdrgm:Version", b"iso:ts:21496:-1", b"hdrgainmap")  # Adobe's and Android's, ISO's, a phone maker's
_HEAD_BYTES, _EXTRA_SAMPLES, _PRIMARIES_TAG = 1 << 20, 338, 319  # declarations precede the pixels
_MEAN = cv2.INTER_AREA
_TOO_DEEP = "folders in folders, which are not read (one folder for each session)"
_ODD_HEADER = re.compile(rb"unknown JFIF|Unknown Adobe|Invalid SOS")
_WARNING = re.compile(rb"Corrupt JPEG data|Premature end of JPEG|Inconsistent progression|" + _ODD_HEADER.pattern)
_PADDING = re.compile(rb"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9\s*")
_MAX_PADDING = 64  # bytes that some cameras write before the end of a picture
_ZERO_RUN = bytes(64)  # takes three blocks of coefficients -1
_LOCK = threading.Lock()  # a process has one stderr


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
    step: int = 1  # pixels of the file to a pixel of `srgb`, in both directions


def read_photo(path: str | Path) -> Photo:
    """Read a photograph; raises `PhotoRejected`: "unreadable" if missing or damaged, "too_costly" beyond `limits`."""
    path = Path(path)
    allow_heic(path)
    try:
        with limit_memory(MOST_BYTES):
            photo, orientation = run_limited(_decode, path)  # by now Pillow's picture has been freed
            down, right = ((1, 1), (1, -1), (-1, -1), (-1, 1))[(orientation - 1) % 4]  # of EXIF 2.32
            pixels = photo.srgb.transpose(1, 0, 2) if orientation > 4 else photo.srgb
            return replace(photo, srgb=np.ascontiguousarray(pixels[::down, ::right]))
    except PhotoRejected:
        raise
    except Exception as error:  # decoders fail in many ways: OSError, SyntaxError, struct.error...
        kind, advice = type(error).__name__, f"{path.name} is damaged or cut short: copy it again from the camera"
        if isinstance(error, MemoryError) or kind == "DecompressionBombError":
            advice = "the picture takes too much memory: save it smaller"
            raise PhotoRejected("too_costly", None, None, advice) from error
        if kind == "FileNotFoundError":
            advice = GONE_ADVICE
        elif kind == "UnidentifiedImageError":
            advice = f"{path.name} is not a picture of a known kind: save it as JPEG or PNG"
        elif isinstance(error, OSError) and error.errno:
            advice = f"{path.name} cannot be read ({error.strerror}): allow that, or copy it again"
        raise PhotoRejected("unreadable", None, None, advice) from error


def _decode(path: Path) -> tuple[Photo, int]:
    """A photograph as it is stored, above `WHOLE_PX` at half size, and its orientation."""
    if (size := path.stat().st_size) > MOST_BYTES:
        advice = f"a file of {size / 1e9:.1f} GB is too large: save it smaller"
        raise PhotoRejected("too_costly", size, MOST_BYTES, advice)
    with warnings.catch_warnings(action="ignore"), open_lazily(path) as image:  # of large pictures and of unusual EXIF
        if (pixels := image.width * image.height) > MAX_IMAGE_PX:
            advice = f"{pixels / 1e6:.0f} megapixels are too many: save it smaller"
            raise PhotoRejected("too_costly", pixels, MAX_IMAGE_PX, advice)
        step = 2 if pixels > WHOLE_PX and min(image.size) > 1 else 1
        focal_px, spread, rejected = read_focal(image)
        dpi, cropped = tuple(map(float, np.ravel(image.info.get("dpi", ())))), is_crop(image, path.name)
        with path.open("rb") as file:
            head = file.read(-1 if image.format == "MPO" else _HEAD_BYTES)
        (orientation, contradiction), rest = _orientation(image), _left_aside(image, head)
        srgb, said = _decode_pixels(image, path, head, step)
        said = (*contradiction, *rest, *said)
        return Photo(srgb, focal_px and focal_px / step, spread, rejected, cropped, dpi, said, step), orientation


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
    return int(orientation) if image.format != "TIFF" and orientation in range(1, 9) else 1, said


def _left_aside(image, head: bytes) -> tuple[str, ...]:
    """What else is in a file besides the picture that is read."""
    said = []
    if any(name in head for name in _GAIN_MAPS):
        said.append(GAIN_MAP)
    elif image.format == "MPO":
        kinds = [entry["Attribute"]["MPType"] for entry in image.mpinfo[0xB002][1:]]
        said += [MORE_PAGES] * any(not kind.startswith("Large Thumbnail") for kind in kinds)
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
    if paths := list_images(folder):
        return paths
    expected, got = f"photographs ({', '.join(sorted(SUFFIXES)[:6])}, ...) in {folder}", list_skipped_files(folder)
    raise Refused(expected, "; ".join(["none", *got]), "copy the photographs there")


def list_images(folder: Path) -> list[Path]:
    """The files of a folder that have a picture's suffix and are not hidden, in the order of their names."""
    files = (p for p in folder.iterdir() if is_file(p) and not p.name.startswith("."))
    return sorted((p for p in files if p.suffix.lower() in SUFFIXES), key=lambda p: p.name)


def subfolders(folder: Path) -> list[Path]:
    """The folders in a folder by name, without hidden ones."""
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def list_skipped_files(folder: Path, without: Path | None = None, depth: int = 1) -> list[str]:
    """Name the files under a folder, except in `without`, that people may have meant as photographs, a phrase for each
    kind: videos and raw files without a picture of the same name, and pictures in folders deeper than `depth`.
    """
    skipped: list[tuple[str, Sequence[str]]] = []
    for parent, folders, files in os.walk(folder):
        inside = Path(parent).relative_to(folder)
        paths = [Path(name) for name in sorted(files) if not name.startswith(".")]
        stems = {path.stem for path in paths if path.suffix.lower() in SUFFIXES}
        folders[:] = sorted(f for f in folders if not f.startswith(".") and Path(parent, f).resolve() != without)
        if len(inside.parts) > depth:
            if stems:
                skipped.append((printable(str(inside)), [_TOO_DEEP]))
            continue
        for path in paths:
            if not Path(parent, path).exists():
                skipped.append((printable(str(inside / path)), ["links to files that are not there"]))
            elif path.stem not in stems and (kind := _SKIPPED_KINDS.get(path.suffix.lower())):
                skipped.append((printable(str(inside / path)), [kind]))
    return summarize_said(skipped)


def summarize_said(said: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Sum up what files of these names declare and was left aside (`Photo.said`): a phrase for each kind."""
    names: dict[str, list[str]] = {}
    for name, phrases in said:
        for phrase in phrases:
            names.setdefault(phrase, []).append(name)
    return [f"{phrase}: {summarize_names(files)}" for phrase, files in names.items()]


def allow_heic(path: Path) -> None:
    """Let Pillow open HEIC files, if this is one; raises `PhotoRejected` without the library for it."""
    if path.suffix.lower() in {".heic", ".heif"}:
        try:
            import pillow_heif  # type: ignore[reportMissingImports]  # an extra
        except ImportError:
            raise PhotoRejected("unreadable", None, None, HEIC_ADVICE) from None
        pillow_heif.register_heif_opener()


def _declared_space(image, head: bytes) -> "tuple[ColorSpace | None, tuple[str, ...]]":
    """See `color_space`, which is loaded only for pictures that may declare another space than sRGB."""
    if image.format in ("JPEG", "MPO", "PNG") and image.mode != "CMYK" and "icc_profile" not in image.info:
        space, adobe = exif_tags(image, EXIF_IFD).get(0xA001), exif_tags(image, 0xA005).get(1) == "R03"
        in_exif = adobe or (space != 1 and (space is not None or _PRIMARIES_TAG in exif_tags(image)))
        in_chunks = {"chromaticity", "gamma"} & image.info.keys()
        if ("srgb" in image.info or not (in_exif or in_chunks)) and (image.format != "PNG" or b"cICP" not in head):
            return None, ()
    from patchproof.photo.color_space import color_space

    return color_space(image, head)


def _decode_pixels(image, path: Path, head: bytes, step: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """uint8 sRGB H×W×3 of an open picture, each the mean of `step` × `step` pixels, and what is left aside of it."""
    space, said = _declared_space(image, head)
    codes = _jpeg_codes(image, path)
    if codes is None:
        image.load()
        if image.mode == "CMYK" and image.format == "JPEG" and "adobe" not in image.info:
            from PIL import ImageChops

            image = ImageChops.invert(image)  # Pillow takes the inks of every JPEG as Adobe's, which are inverted
        if image.mode[0] in "FI" or image.format == "TIFF" or (image.format == "PNG" and head[24] == 16):
            from patchproof.photo.color_space import deep_codes

            codes, space, assumed = deep_codes(image, path, space)
            said += assumed
    if codes is not None and space is None and step == 1:
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
            strip = part if space is None else space.to_srgb(part)
        if step > 1:  # an incomplete group at the right is dropped
            strip = cv2.resize(strip[:, : step * pixels.shape[1]], pixels[top:bottom].shape[1::-1], interpolation=_MEAN)
        pixels[top:bottom] = strip
    return pixels, said


def _jpeg_codes(image, path: Path) -> np.ndarray | None:
    """uint8 H×W×3 of a JPEG, which OpenCV decodes to the same bits in half the time; None for inks and other files."""
    if image.format not in ("JPEG", "MPO"):
        return None
    inks = image.mode not in ("RGB", "L")
    pixels = decode_jpeg(path.read_bytes(), cv2.IMREAD_REDUCED_COLOR_8 if inks else cv2.IMREAD_COLOR_RGB)
    return None if inks or pixels is None or pixels.shape[1::-1] != image.size else pixels


def _opaque_srgb(image, space: "ColorSpace | None") -> np.ndarray:
    """uint8 sRGB H×W×3 of a part of a picture, on white where it is transparent."""
    from PIL import Image

    if image.mode == "La":  # Pillow converts it to nothing else
        image = image.convert("LA")
    if clear := "transparency" in image.info or image.mode in {"RGBA", "LA", "PA", "RGBa"}:
        image = image.convert("RGBA")
    colors = image.convert("RGB" if space is None else space.mode)
    if space is not None:
        colors = Image.fromarray(space.to_srgb(np.asarray(colors)))
    if clear:
        colors.putalpha(image.getchannel("A"))
        colors = Image.alpha_composite(Image.new("RGBA", image.size, "white"), colors).convert("RGB")
    return np.asarray(colors)


def decode_jpeg(content: bytes, flags: int = cv2.IMREAD_COLOR_RGB) -> np.ndarray | None:
    """uint8 H×W×3 as stored, None where OpenCV cannot decode it; a ValueError if it is damaged."""
    pixels, warning = _decode_and_listen(content, flags)
    if not warning and _ZERO_RUN not in content:
        return pixels
    start, zeros_are_flat = _start_of_scan(content)
    if _ODD_HEADER.search(warning):
        head = content[:start].replace(b"JFIF\0", b"jfif\0").replace(b"Adobe", b"adobe")
        end = start + 2 + int.from_bytes(content[start + 2 : start + 4])
        plain = b"\0\x3f\0" if b"SOS" in warning else content[end - 3 : end]
        warning = _decode_and_listen(head + content[start : end - 3] + plain + content[end:], flags)[1]
    scan = content[start : content.find(b"\xff\xd9", start)]
    padding = _PADDING.fullmatch(warning)
    padded = padding and (size := int(padding[1])) <= _MAX_PADDING and not scan[-size:].strip(b"\0\xff")
    zeroed = _ZERO_RUN in scan and not zeros_are_flat and scan.count(b"\xff\xda") == 1
    if (warning and not padded) or zeroed:
        raise ValueError(warning.decode("latin-1") or "zeros among its pixels")
    return pixels


def _decode_and_listen(content: bytes, flags: int) -> tuple[np.ndarray | None, bytes]:
    """OpenCV's pixels and what libjpeg writes to stderr; other lines there are passed on."""
    pixels, data = None, np.frombuffer(content, np.uint8)
    with _LOCK, tempfile.TemporaryFile() as file:
        try:
            stderr = os.dup(2)
        except OSError:  # a process without stderr
            stderr = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(file.fileno(), 2)
            with suppress(cv2.error):
                pixels = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
        finally:
            os.dup2(stderr, 2)
            file.seek(0)
            lines = file.readlines()
            with suppress(OSError):  # 2 is any file in a process without stderr
                os.write(stderr, b"".join(line for line in lines if not _WARNING.search(line)))
            os.close(stderr)
    return pixels, b"".join(filter(_WARNING.search, lines))


def _start_of_scan(content: bytes) -> tuple[int, bool]:
    """The offset of the first scan, and whether zeros can be flat blocks: their code ends one in the first."""
    at, first_symbol = 2, {}
    while at + 4 < len(content) and content[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(content[at + 2 : at + 4])
        table = at + 4
        while content[at + 1] == 0xC4 and table + 17 < end:
            first_symbol[content[table]] = content[table + 17]
            table += 17 + sum(content[table + 1 : table + 17])
        at = end
    ac_table = 0x10 | content[at + 6] & 15 if at + 6 < len(content) else 0
    return at, first_symbol.get(ac_table, 0) == 0
