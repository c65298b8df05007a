"""Read pictures of more than 8 bits a channel: integers of a declared depth, or floating-point light.

16-bit RGB is decoded by OpenCV, since Pillow keeps 8 bits of it. Floating-point values are linear light. A maximum of
10, 12 or 14 bits in TIFF's tags is the depth; other maxima are statistics.
"""

from pathlib import Path

import cv2
import numpy as np

from patchproof.photo.color_space import SRGB_PRIMARIES, ColorSpace, eight_bits, rgb_space

LINEAR_LIGHT = "floating-point values, read as linear light from 0 to 1, or to their maximum above 1"
SHALLOW = "16-bit values that all fit into {} bits, which the file does not declare: read as dark as it stores them"
_BITS, _INVERTED, _MAXIMA, _SIGNED = 258, 262, (341, 281), 339
_DEPTHS = {1023: 10, 4095: 12, 16383: 14}


def deep_codes(
    image, path: Path, space: ColorSpace | None
) -> tuple[np.ndarray | None, ColorSpace | None, tuple[str, ...]]:
    """(uint16 codes H×W×3, or None of 8 bits; their space if the picture declares `space`; how a range is assumed)."""
    tags, said = getattr(image, "tag_v2", {}), ()
    bits, signed = tags.get(_BITS, (16,))[0], tags.get(_SIGNED, (1,))[0] == 2
    if image.mode == "F":
        codes = np.nan_to_num(np.asarray(image), posinf=1.0)
        space, said = rgb_space(SRGB_PRIMARIES, None, 1.0), (LINEAR_LIGHT,)
        top = max(1.0, float(codes.max(initial=0)))
    elif image.mode.startswith("I"):
        codes, top = np.asarray(image), (1 << bits - signed) - 1
        codes = codes.view(np.uint32) if bits == 32 and not signed else codes
    else:
        codes, top = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if (image.mode, bits) == ("RGB", 16) else None, 65535
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
