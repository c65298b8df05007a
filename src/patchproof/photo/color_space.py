"""Convert a picture's colors to sRGB from the color space that its file declares.

A profile is recognized by what it does to colors, never by its name. In a PNG, cICP precedes the profile, the profile
the sRGB chunk, and that cHRM and gAMA; elsewhere the profile precedes nclx and EXIF. ColorSpace 65535 means any other
space: it is read as Adobe RGB only with interoperability R03, since some phones write it over sRGB. Colors outside of
sRGB are clipped. Of more than 8 bits, 16-bit RGB is decoded by OpenCV, since Pillow keeps 8; floating-point values are
linear light. A maximum of 10, 12 or 14 bits in TIFF's tags is the depth; other maxima are statistics.
"""

import io
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from patchproof.base.color import codes_from_srgb, linear_from_srgb, srgb_from_linear
from patchproof.photo.exif import EXIF_IFD, exif_tags
from patchproof.photo.rejection import PhotoRejected

BROKEN_PROFILE = "color profiles that cannot be used, whose pictures are read as sRGB"
UNNAMED_SPACE = "EXIF color spaces that are neither sRGB nor named, read as sRGB"
CONTRADICTION = "Adobe RGB beside sRGB in EXIF, read as sRGB"
BROKEN_PRIMARIES = "primaries or gammas that no screen has, read as sRGB"
BMP_SPACE = "color spaces in BMP files, read as sRGB"
BARE_INKS = "inks (CMYK) without a profile, of which RGB is only an estimate"
_HDR = "it has colors for HDR screens or of a kind that is not read (cICP {}, {}): save it as JPEG in sRGB"
SRGB_PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)  # x and y of red, green and blue
_ADOBE, _ADOBE_GAMMA = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06), 563 / 256
_P3, _BT2020 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06), (0.708, 0.292, 0.17, 0.797, 0.131, 0.046)
_PAL, _NTSC = (0.64, 0.33, 0.29, 0.60, 0.15, 0.06), (0.63, 0.34, 0.31, 0.595, 0.155, 0.07)
# by their numbers in ITU-T H.273 (2: not specified), primaries that are white at D65, and curves
_PRIMARIES = {1: SRGB_PRIMARIES, 2: SRGB_PRIMARIES, 5: _PAL, 6: _NTSC, 7: _NTSC, 9: _BT2020, 12: _P3}
_CURVES = {2: None, 13: None, **dict.fromkeys((1, 6, 14, 15), "television"), 4: 2.2, 5: 2.8, 8: 1.0}
_D65, _MAX_GAMMA = (0.3127, 0.329), 5.0
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_INTEROP_IFD, _COLOR_SPACE, _GAMMA, _WHITE_TAG, _PRIMARIES_TAG = 0xA005, 0xA001, 0xA500, 318, 319
_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}  # of pictures, by their profile's
LINEAR_LIGHT = "floating-point values, read as linear light from 0 to 1, or to their maximum above 1"
SHALLOW = "16-bit values that all fit into {} bits, which the file does not declare: read as dark as it stores them"
_BITS, _INVERTED, _ORIENTATION, _PLANES, _MAXIMA, _SIGNED = 258, 262, 274, 284, (341, 281), 339
_PLANES_ADVICE = "its 16-bit colors are stored in planes: save it interleaved, pixel by pixel, or as PNG"
_DEPTHS = {1023: 10, 4095: 12, 16383: 14}


class ColorSpace(NamedTuple):
    """Pillow's mode of a picture's codes, and their conversion to sRGB uint8 H×W×3."""

    mode: str  # "RGB", "L" or "CMYK"
    to_srgb: Callable[[np.ndarray], np.ndarray]  # of uint8, or RGB also of uint16


def color_space(image, head: bytes) -> tuple[ColorSpace | None, tuple[str, ...]]:
    """The color space of a picture in a file with this `head`, None for sRGB, and sentences on what is left aside."""
    profile = image.info.get("icc_profile", b"")
    if profile is None:  # a part of it is missing
        return None, (BROKEN_PROFILE,)
    if (cicp := _cicp(image.format, head)) and (image.format == "PNG" or not profile):
        primaries, transfer, full_range = cicp
        if primaries not in _PRIMARIES or transfer not in _CURVES or not full_range:
            raise PhotoRejected("unreadable", None, None, _HDR.format(primaries, transfer))
        return rgb_space(_PRIMARIES[primaries], None, _CURVES[transfer]), ()
    if profile:
        return _space_of_profile(profile, image.mode)
    if image.mode == "CMYK":
        return None, (BARE_INKS,)
    if image.format == "BMP" and int.from_bytes(head[14:18], "little") >= 108:  # a header of version 4 or 5
        return None, () if head[70:74] in (b"BGRs", b" niW") else (BMP_SPACE,)
    declared, said = (None, ()) if "srgb" in image.info else _declared_primaries(image)
    try:
        return declared and rgb_space(*declared), said
    except (ValueError, TypeError, ArithmeticError, np.linalg.LinAlgError):
        return None, (BROKEN_PRIMARIES,)


def rgb_space(
    primaries: Sequence[float], white: Sequence[float] | None, curve: float | str | None
) -> ColorSpace | None:
    """The space of these chromaticities and this curve (None: sRGB's); None if sRGB, ValueError if no screen has it."""
    if isinstance(curve, float) and not 1 / _MAX_GAMMA <= curve <= _MAX_GAMMA:
        raise ValueError(f"gamma {curve:g}")
    matrix = np.linalg.solve(_xyz_from_rgb(SRGB_PRIMARIES, _D65), _xyz_from_rgb(primaries, white or _D65))

    def to_srgb(codes: np.ndarray) -> np.ndarray:
        light = np.linspace(0, 1, np.iinfo(codes.dtype).max + 1)
        if isinstance(curve, str):  # that of BT.709, 601 and 2020
            light = np.where(light < 0.081, light / 4.5, ((light + 0.099) / 1.099) ** (1 / 0.45))
        else:
            light = linear_from_srgb(light) if curve is None else light**curve
        linear = cv2.transform(np.take(65535 * light.astype(np.float32), codes), matrix.astype(np.float32))
        return np.take(_srgb_codes(), np.clip(linear + 0.5, 0, 65535).astype(np.uint16))

    return _unless_srgb(ColorSpace("RGB", to_srgb))


def eight_bits(codes: np.ndarray) -> np.ndarray:
    """uint8 of uint8 or uint16 codes."""
    return codes if codes.dtype == np.uint8 else cv2.convertScaleAbs(codes, alpha=255 / 65535)


@lru_cache(1)
def _srgb_codes() -> np.ndarray:
    return codes_from_srgb(srgb_from_linear(np.arange(65536) / 65535))


def _unless_srgb(space: ColorSpace) -> ColorSpace | None:
    """None if the space moves no color of a lattice by more than the rounding of 8 bits."""
    ramp = np.arange(0, 256, 15, dtype=np.uint8)
    codes = np.stack(np.meshgrid(ramp, ramp, ramp), -1).reshape(1, -1, 3) if space.mode == "RGB" else ramp[None]
    moved = space.mode == "CMYK" or np.abs(space.to_srgb(codes) - codes.reshape(*codes.shape[:2], -1).astype(int)) > 1
    return space if np.any(moved) else None


def _xyz_from_rgb(primaries: Sequence[float], white: Sequence[float]) -> np.ndarray:
    """The matrix from linear RGB to XYZ, adapted to D65."""
    points = np.array([*_D65, *white, *primaries], float).reshape(5, 2)
    if not (np.abs(points) < 1.5).all() or not points[:, 1].all():
        raise ValueError("chromaticities")
    d65, own_white, *columns = np.c_[points, 1 - points.sum(1)] / points[:, 1:]
    matrix = np.transpose(columns) * np.linalg.solve(np.transpose(columns), own_white)
    return np.linalg.solve(_BRADFORD, (_BRADFORD @ d65 / (_BRADFORD @ own_white))[:, None] * _BRADFORD) @ matrix


def _cicp(kind: str, head: bytes) -> tuple[int, int, bool] | None:
    """(primaries, transfer, full range) of a PNG's cICP chunk, or of the first nclx box; None without one."""
    if kind == "PNG" and (at := head.find(b"\0\0\0\4cICP", 0, head.find(b"IDAT"))) >= 0:
        return head[at + 8], head[at + 9], head[at + 10 : at + 12] == b"\0\1"
    if kind in ("AVIF", "HEIF") and (at := head.find(b"colrnclx")) >= 0:
        return int.from_bytes(head[at + 8 : at + 10]), int.from_bytes(head[at + 10 : at + 12]), True
    return None


@lru_cache(4)
def _space_of_profile(profile: bytes, mode: str) -> tuple[ColorSpace | None, tuple[str, ...]]:
    """The space of an embedded profile; said if it is broken or belongs to pictures of another mode."""
    from PIL import Image, ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        own_mode = _MODES[source.profile.xcolor_space.strip()]  # type: ignore[reportAttributeAccessIssue]
        if (own_mode == "CMYK") != (mode == "CMYK") or (own_mode == "L" and mode[0] not in "1LI"):
            return None, (BROKEN_PROFILE,)
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), own_mode, "RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, KeyError, TypeError):
        return None, (BROKEN_PROFILE,)

    def to_srgb(codes: np.ndarray) -> np.ndarray:
        # deep gray has three channels, which are equal
        part = eight_bits(codes[..., 0] if own_mode == "L" and codes.ndim == 3 else codes)
        image = Image.frombuffer(own_mode, part.shape[1::-1], np.ascontiguousarray(part), "raw", own_mode, 0, 1)
        return np.asarray(ImageCms.applyTransform(image, transform))

    return _unless_srgb(ColorSpace(own_mode, to_srgb)), ()


def _declared_primaries(image) -> tuple[tuple[Any, Any, float | None] | None, tuple[str, ...]]:
    """The arguments of `rgb_space` by PNG's chunks or EXIF and TIFF tags, None for sRGB, and what is left aside."""
    chunk, gamma = image.info.get("chromaticity", ()), image.info.get("gamma")
    if chunk or gamma is not None:
        return (chunk[2:] or SRGB_PRIMARIES, chunk[:2], None if gamma is None else float(np.divide(1, gamma))), ()
    exif, details, adobe = exif_tags(image), exif_tags(image, EXIF_IFD), exif_tags(image, _INTEROP_IFD).get(1) == "R03"
    space, gamma = details.get(_COLOR_SPACE), details.get(_GAMMA)
    if space == 2 or (adobe and space != 1):
        return (_ADOBE, None, _ADOBE_GAMMA), ()
    if _PRIMARIES_TAG in exif and space != 1:
        return (exif[_PRIMARIES_TAG], exif.get(_WHITE_TAG), None if gamma is None else float(gamma)), ()
    return None, (CONTRADICTION,) if adobe else (UNNAMED_SPACE,) if space not in (None, 1) else ()


def deep_codes(
    image, path: Path, space: ColorSpace | None
) -> tuple[np.ndarray | None, ColorSpace | None, tuple[str, ...]]:
    """(uint16 codes H×W×3, or None of 8 bits; their space if the picture declares `space`; how a range is assumed)."""
    tags, said = getattr(image, "tag_v2", {}), ()
    bits, signed = tags.get(_BITS, (16,))[0], tags.get(_SIGNED, (1,))[0] == 2
    if bits == 16 and image.mode in ("RGB", "RGBA") and tags.get(_PLANES) == 2:
        raise PhotoRejected("unreadable", None, None, _PLANES_ADVICE)  # neither OpenCV nor Pillow reads them
    if image.mode == "F":
        codes = np.nan_to_num(np.asarray(image), posinf=1.0)
        space, said = rgb_space(SRGB_PRIMARIES, None, 1.0), (LINEAR_LIGHT,)
        top = max(1.0, float(codes.max(initial=0)))
    elif image.mode.startswith("I"):
        codes, top = np.asarray(image), (1 << bits - signed) - 1
        codes = codes.view(np.uint32) if bits == 32 and not signed else codes
    else:
        deep = (image.mode, bits) == ("RGB", 16) and tags.get(_ORIENTATION, 1) < 5  # OpenCV fails at turned ones
        codes, top = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if deep else None, 65535
        if codes is None or codes.dtype != np.uint16 or codes.shape != (image.height, image.width, 3):
            return None, space, ()
        codes = codes[..., ::-1]
    if top == 65535 and image.mode != "F":
        top = next((tags[tag][0] for tag in _MAXIMA if tag in tags and tags[tag][0] in _DEPTHS), top)
        limit = next((limit for limit in _DEPTHS if 0 < codes.max(initial=0) <= limit < top), None)
        said = (SHALLOW.format(_DEPTHS[limit]),) if limit else ()
    codes = top - codes if tags.get(_INVERTED) == 0 else codes
    if top != 65535 or codes.dtype != np.uint16:
        codes = np.clip(codes * np.float32(65535 / top) + np.float32(0.5), 0, 65535).astype(np.uint16)
    codes = codes if codes.ndim == 3 else np.repeat(codes[..., None], 3, axis=2)
    return codes, space or ColorSpace("RGB", eight_bits), said
