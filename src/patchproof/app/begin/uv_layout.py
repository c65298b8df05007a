"""An object's texture coordinates as pictures to draw a mask on, with the face numbers that `patch.faces` takes.

In: a mesh whose materials carry textures, as a scene of kind "texture" or "masked" has it. Out: for each texture a
picture of as many pixels, or of a whole multiple where that makes room for numbers, so that a mask drawn on it fits
texel by texel: the texture in pale, paler still where it may not change, faces outlined and the rims of UV islands in
black, and each face's number at its middle where it fits. Coordinates beyond the texture wrap: a face lies where its
middle does. Of faces that share a middle the first is named.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from patchproof.scene.texture import Canvas

LARGEST_PX = 2048  # along a side, of pictures that are larger than their texture
FONT_PX = (30, 9)  # the largest number, and the smallest that can be read
_PALE, _PALER = 0.5, 0.85  # of the way to white
_RIM, _LINE, _NUMBER = (0, 0, 0), (110, 110, 110), (200, 0, 70)


@dataclass(frozen=True)
class UvLayout:
    """One texture's picture; `faces` are those that it shows, and `numbered` those of them that have room for it."""

    material: str
    picture: np.ndarray  # uint8 H×W×3
    texels: tuple[int, int]  # width, height of the texture
    faces: int
    numbered: tuple[int, ...]


def uv_layouts(canvas: Canvas) -> list[UvLayout]:
    """A picture of each texture that a face shows; one-colored ones that may not change have no texels to draw on."""
    mesh, layouts = canvas.mesh, []
    for index, (start, mask) in enumerate(zip(canvas.start_srgb, canvas.mask, strict=True)):
        faces = np.flatnonzero(mesh.face_material == index)
        if mask.size > 1 and len(faces):
            size = mask.shape[1], mask.shape[0]
            times = max(1, LARGEST_PX // max(size))
            corners = _within(np.nan_to_num(mesh.corner_uv[faces].astype(float))) * size * times
            picture, numbered = _drawn(_paled(start, mask).repeat(times, 0).repeat(times, 1), corners, faces)
            layouts.append(UvLayout(canvas.names[index], picture, size, len(faces), numbered))
    return layouts


def centers_px(corners: np.ndarray) -> np.ndarray:
    """The middles F×2 of triangles F×3×2."""
    return corners.mean(1)


def _within(uv: np.ndarray) -> np.ndarray:
    """Faces F×3×2 moved by whole textures, their middles into the first one."""
    return uv - np.floor(uv.mean(1, keepdims=True))


def _paled(texture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    share = np.where(mask, _PALE, _PALER)[..., None]
    return np.rint(texture + share * (255.0 - texture)).astype(np.uint8)


def _drawn(pale: np.ndarray, corners: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    from PIL import Image, ImageDraw

    image = Image.fromarray(pale)
    draw = ImageDraw.Draw(image)
    for triangle in corners.tolist():
        draw.polygon([tuple(point) for point in triangle], outline=_LINE)
    for a, b in _rims(corners).tolist():
        draw.line((*a, *b), fill=_RIM, width=2)
    numbered, named = [], set()
    for face, middle, room in zip(faces.tolist(), centers_px(corners), _rooms(corners).tolist(), strict=True):
        place = tuple(np.rint(middle).astype(int).tolist())
        font = None if place in named else _font(str(face), room)
        if font is not None:
            draw.text(tuple(middle.tolist()), str(face), fill=_NUMBER, font=font, anchor="mm")
            numbered.append(face)
            named.add(place)
    return np.asarray(image), tuple(numbered)


def _rims(corners: np.ndarray) -> np.ndarray:
    """Edges E×2×2 that one face alone has: the rims of islands."""
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], 2).reshape(-1, 2, 2)
    keys = np.rint(edges * 16).astype(np.int64)  # neighbors round their shared corners alike
    swap = (keys[:, 0] > keys[:, 1])[:, 0] | ((keys[:, 0, 0] == keys[:, 1, 0]) & (keys[:, 0, 1] > keys[:, 1, 1]))
    keys[swap] = keys[swap][:, ::-1]
    _, which, count = np.unique(keys.reshape(-1, 4), axis=0, return_inverse=True, return_counts=True)
    return edges[count[which.reshape(-1)] == 1]


def _rooms(corners: np.ndarray) -> np.ndarray:
    """How far the middle of each triangle F×3×2 lies from its nearest side: a third of the height over the longest."""
    sides = np.roll(corners, -1, axis=1) - corners
    twice = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    return twice / (3 * np.maximum(np.linalg.norm(sides, axis=2).max(1), 1e-12))


def _font(number: str, room_px: float) -> Any:
    """The largest font in which a number stays within a circle; None where even the smallest does not."""
    from PIL import ImageFont

    # digits of Pillow's own font are 0.58 of its size wide and 0.73 high
    half_diagonal = 0.5 * float(np.hypot(0.58 * len(number), 0.73))
    size = min(int(room_px / half_diagonal), FONT_PX[0])
    return ImageFont.load_default(size) if size >= FONT_PX[1] else None
