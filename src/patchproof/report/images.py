"""Pictures for a page without files: arrays as data URIs, color differences as a map with a fixed scale.

In: uint8 sRGB H×W×3 or float cells. Out: JPEG or PNG bytes, and `data:` URIs. The scale of the map is the same in all
reports, so that two reports can be laid side by side.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from patchproof.base.output import image_bytes, make_folder

DELTA_TOP = 20.0  # ΔE00 at the map's dark end; 2 is just visible side by side, 20 another color
KINDS = ("photo", "promised", "seen", "fitted", "delta_e00")
_JPEG_QUALITY = 82
_LONGEST_STEM = 220  # bytes; systems take 255, and kind and suffix come after it
_PNG = b"\x89PNG"


def jpeg(pixels: np.ndarray) -> bytes:
    """uint8 sRGB as JPEG, for photographs."""
    return image_bytes(pixels, "JPEG", {"quality": _JPEG_QUALITY, "optimize": True})


def png(pixels: np.ndarray) -> bytes:
    """uint8 sRGB or sRGB with alpha as PNG, for flat colors."""
    return image_bytes(pixels, "PNG", {"optimize": True})


def encoded(kinds: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """A photograph's pictures by kind as JPEG, its `delta_e00` cells (NaN = not measured) as the PNG of a map."""
    return {kind: png(delta_map(a)) if kind == "delta_e00" else jpeg(a) for kind, a in sorted(kinds.items())}


def save_pictures(folder: Path, file: str, kinds: Mapping[str, np.ndarray]) -> None:
    """Write the pictures of the photograph `file` as FILE.KIND.jpg or .png into `folder`, in place of earlier ones."""
    make_folder(folder)
    for path in _paths(folder, file):
        path.unlink(missing_ok=True)
    for kind, content in encoded(kinds).items():
        suffix = "png" if content.startswith(_PNG) else "jpg"
        (folder / f"{stem_of(file)}.{kind}.{suffix}").write_bytes(content)


def saved_pictures(folder: Path, file: str) -> dict[str, bytes]:
    """The bytes of the photograph's pictures in `folder` by kind; those that are there."""
    return {path.suffixes[-2][1:]: path.read_bytes() for path in _paths(folder, file) if path.is_file()}


def stem_of(file: str) -> str:
    """How the pictures of a photograph begin, which may lie in a folder of its session; no longer than names may be."""
    stem = file.replace("/", "%2F")
    if len(stem.encode()) <= _LONGEST_STEM:
        return stem
    return f"{stem[:40]}-{hashlib.sha256(stem.encode()).hexdigest()[:16]}"


def _paths(folder: Path, file: str) -> list[Path]:
    return [folder / f"{stem_of(file)}.{kind}.{suffix}" for kind in KINDS for suffix in ("jpg", "png")]


def data_uri(content: bytes) -> str:
    """The bytes of a JPEG or PNG as something that `<img src>` takes."""
    return base64_uri(content, f"image/{'png' if content.startswith(_PNG) else 'jpeg'}")


def base64_uri(content: bytes, kind: str) -> str:
    """Bytes of that media type as an address that needs no file."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def delta_map(delta_e00: np.ndarray, longer_px: int = 192) -> np.ndarray:
    """ΔE00 cells as uint8 RGBA squares: pale is equal, dark is `DELTA_TOP` or more, see-through is not measured."""
    import matplotlib

    colors = matplotlib.colormaps["magma_r"](np.clip(np.nan_to_num(delta_e00) / DELTA_TOP, 0, 1), bytes=True)
    colors[np.isnan(delta_e00), 3] = 0
    zoom = max(1, longer_px // max(delta_e00.shape))
    return np.repeat(np.repeat(colors, zoom, axis=0), zoom, axis=1)
