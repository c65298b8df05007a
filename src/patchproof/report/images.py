"""Pictures for a page without files: arrays as data URIs, colour differences as a map with a fixed scale.

In: uint8 sRGB H×W×3 or float cells. Out: JPEG or PNG bytes, and `data:` URIs. The scale of the map is the same in all
reports, so that two reports can be laid side by side.
"""

from __future__ import annotations

import base64
import io

import numpy as np

DELTA_TOP = 20.0  # ΔE00 at the map's dark end; 2 is just visible side by side, 20 another colour
_JPEG_QUALITY = 82


def jpeg(pixels: np.ndarray) -> bytes:
    """uint8 sRGB as JPEG, for photographs."""
    return _encoded(pixels, "JPEG", {"quality": _JPEG_QUALITY, "optimize": True})


def png(pixels: np.ndarray) -> bytes:
    """uint8 sRGB or sRGB with alpha as PNG, for flat colours."""
    return _encoded(pixels, "PNG", {"optimize": True})


def data_uri(content: bytes) -> str:
    """The bytes of a JPEG or PNG as something that `<img src>` takes."""
    kind = "png" if content.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def delta_map(delta_e00: np.ndarray, longer_px: int = 192) -> np.ndarray:
    """ΔE00 cells as uint8 RGBA squares: pale is equal, dark is `DELTA_TOP` or more, see-through is not measured."""
    import matplotlib

    colors = matplotlib.colormaps["magma_r"](np.clip(np.nan_to_num(delta_e00) / DELTA_TOP, 0, 1), bytes=True)
    colors[np.isnan(delta_e00), 3] = 0
    zoom = max(1, longer_px // max(delta_e00.shape))
    return np.repeat(np.repeat(colors, zoom, axis=0), zoom, axis=1)


def _encoded(pixels: np.ndarray, kind: str, options: dict) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, kind, **options)
    return buffer.getvalue()
