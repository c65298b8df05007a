"""Read EXIF data: the focal length, unless the picture was changed since it was taken; its time and its camera.

EXIF gives the 35 mm equivalent, by the diagonal: if a picture was cropped or zoomed digitally, neither that nor the
principal point in the middle is true. So it is rejected if EXIF has another size than the picture or a digital zoom, or
if no sensor has the picture's shape. Pictures saved by an editor, and 16:9, which cameras cut from 4:3 or 3:2, get a
larger spread. A crop that keeps the shape and updates EXIF leaves no trace; the sheet's perspective may contradict it.
`is_crop` has other rules: a picture that was downscaled, or zoomed by its camera, is still a whole photograph.
"""

import math
import re
import struct
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from patchproof.base.errors import TimeLimitExceeded
from patchproof.base.input import open_lazily

_DIAGONAL_35MM = 43.2666  # mm, of the 36×24 mm frame that FocalLengthIn35mmFilm refers to
EXIF_SPREAD = 0.03  # of its logarithm: rounding to whole millimeters at 26 mm (0.011), and tolerances of lenses
LOOSE_SPREAD = 0.1
_SENSOR_SHAPES, _CUT_SHAPES, _SAME_SHAPE = (4 / 3, 3 / 2), (16 / 9,), 0.01
_EDITOR = re.compile(r"photoshop|lightroom|gimp|snapseed|darktable|affinity|paint|pixelmator|capture one|luminar", re.I)
EXIF_IFD, _FOCAL_35MM, _WIDTH, _HEIGHT, _ZOOM = 0x8769, 0xA405, 0xA002, 0xA003, 0xA404
_SOFTWARE, _MAKER, _MODEL, _ORIENTATION, _TIME, _SERIAL = 0x0131, 0x010F, 0x0110, 0x0112, 0x9003, 0xA431
_COMMENT = 0x9286  # marks screenshots of phones and desktops of one maker
_SCREEN = re.compile(r"screen.?shot", re.I)


def exif_tags(image, inner_list: int = 0) -> Mapping[int, Any]:
    """A picture's EXIF tags, or those of an inner list; none if they cannot be read."""
    try:
        exif = image.getexif()
        return exif.get_ifd(inner_list) if inner_list else exif
    except (TypeError, ValueError, ArithmeticError, LookupError, SyntaxError, OSError, struct.error):
        return {}


def _stated_sides(details: Mapping[int, Any]) -> list[float]:
    """The shorter and the longer side in pixels that EXIF states; empty if it does not state both."""
    sides = sorted(side for key in (_WIDTH, _HEIGHT) if (side := _number(details.get(key))) is not None)
    return sides if len(sides) == 2 else []


def read_focal(image) -> tuple[float | None, float, bool]:
    """(focal length in pixels or None, standard deviation of its logarithm, True if EXIF has one that was rejected)."""
    details, (long, short) = exif_tags(image, EXIF_IFD), sorted(image.size, reverse=True)
    focal_35mm, zoom = _number(details.get(_FOCAL_35MM)), _number(details.get(_ZOOM))
    if focal_35mm is None:  # 0 means unknown in EXIF
        return None, EXIF_SPREAD, False
    resized = bool(stated := _stated_sides(details)) and stated != [short, long]
    if resized or (zoom is not None and zoom > 1.01) or not _has_shape(long, short, _SENSOR_SHAPES + _CUT_SHAPES):
        return None, EXIF_SPREAD, True
    edited = bool(_EDITOR.search(str(exif_tags(image).get(_SOFTWARE, ""))))
    uncertain = edited or not _has_shape(long, short, _SENSOR_SHAPES)
    return focal_35mm / _DIAGONAL_35MM * math.hypot(long, short), LOOSE_SPREAD if uncertain else EXIF_SPREAD, False


def is_crop(image, name: str) -> bool:
    """True if EXIF states another shape than the picture's, or EXIF or the file's name declares a screenshot."""
    stated = _stated_sides(details := exif_tags(image, EXIF_IFD))
    reshaped = bool(stated) and not _has_shape(max(image.size), min(image.size), (stated[1] / stated[0],))
    comment = details.get(_COMMENT, "")
    comment = comment.decode("latin-1").replace("\0", "") if isinstance(comment, bytes) else str(comment)
    return reshaped or bool(_SCREEN.search(name) or _SCREEN.search(comment))


def time_and_camera(path: Path) -> tuple[float | None, str]:
    """Time, in minutes since the year 1, and camera by the file's EXIF data; None if either is missing."""
    time, model, serial = _words(path, (_TIME, _MODEL, _SERIAL))
    with suppress(ValueError):
        minutes = (datetime.strptime(time, "%Y:%m:%d %H:%M:%S") - datetime.min).total_seconds() / 60
        return minutes, " ".join(f"{model} {serial}".split())[:40]
    return None, ""


def camera_state(path: Path) -> tuple[str, str]:
    """(maker and model, orientation) by the file's EXIF data."""
    make, model, orientation = _words(path, (_MAKER, _MODEL, _ORIENTATION))
    return f"{make} {model}".strip(), orientation


def _words(path: Path, tags: Sequence[int]) -> list[str]:
    """The words of a file's EXIF tags, empty where there are none, or its data are damaged."""
    try:
        with warnings.catch_warnings(action="ignore"), open_lazily(path) as image:
            exif = image.getexif()
            details = exif.get_ifd(EXIF_IFD)
            return [str(exif.get(tag) or details.get(tag) or "").strip("\0 ") for tag in tags]
    except TimeLimitExceeded:
        raise
    except Exception:  # of whatever a damaged file makes of its data, which Pillow decodes when it is asked for
        return [""] * len(tags)


def has_camera_shape(size_px: tuple[int, int], also_px: tuple[int, int] | None) -> bool:
    """True if cameras take pictures of this shape (4:3, 3:2, 16:9, square), or if it is the shape of `also_px`."""
    also = () if also_px is None else (max(also_px) / min(also_px),)
    return _has_shape(max(size_px), min(size_px), (*_SENSOR_SHAPES, *_CUT_SHAPES, 1.0, *also))


def _has_shape(long: int, short: int, shapes: tuple[float, ...]) -> bool:
    """True if the sides have one of the ratios, to within a percent, or a pixel in small pictures."""
    return any(abs(long - shape * short) <= max(_SAME_SHAPE * long, 1 + shape) for shape in shapes)


def _number(value) -> float | None:
    """A positive finite number, else None."""
    with suppress(TypeError, ValueError, ZeroDivisionError):
        return number if math.isfinite(number := float(value or 0)) and number > 0 else None
