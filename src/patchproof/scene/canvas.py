"""What of an object's own texture may change: a canvas of textures, masks and the mesh that shows them.

In: a mesh and the `[patch]` table of kind "texture" (everything) or "masked" (an image over UV space, material names,
or a file of face numbers). Out: a `Canvas`. Each material carries one texture that is its whole color: base colors are
multiplied in (to 8-bit rounding the object looks as before), so that a texel reaches every color that paint can have.
Faces without texture coordinates are unwrapped first (see `unwrap`). Warned about: texels that show at several places,
palettes, vertex colors that go on multiplying, and faces that change although nobody named them.
Left out on purpose: making texture coordinates better than they are; textures keep their own sizes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, open_image
from patchproof.base.settings import PatchSettings
from patchproof.base.validation import expand_path, spelling_hint
from patchproof.mesh.mesh import Material, Mesh, position_numbers
from patchproof.mesh.unwrap import has_usable_uv, unwrap
from patchproof.mesh.uv_coverage import coverage, texels_per_face

TEXELS = 1024  # side of a texture that has to be made: 0.7 mm per texel over a cube of 300 mm
GUTTER_TEXELS = 1.5  # every texel that a face touches and one more: what bilinear look-ups within the face can read
GRAY = 128  # sRGB 0.5
_WORTH_SAYING = 0.05  # share of the surface
# a texel that stands for this many times its even share of the surface belongs to a palette, not to a picture
_PALETTE = 16


@dataclass(frozen=True)
class Canvas:
    """The object as it is rendered, and which of its texels may change from what start."""

    mesh: Mesh  # every material with a texture and base color 1: the bare object
    start_srgb: tuple[np.ndarray, ...]  # uint8 H×W×3 per material
    mask: tuple[np.ndarray, ...]  # bool H×W per material: may change
    warnings: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The materials' names as in the mesh file; they may repeat."""
        return tuple(material.name for material in self.mesh.materials)


def texture_canvas(mesh: Mesh, patch: PatchSettings, base: Path, texels: int = TEXELS) -> Canvas:
    """The canvas of `mesh` for patch kinds "texture" and "masked"; files are relative to `base`.

    `texels` is the side of textures that have to be made. A mask image is stretched over the UV square of each
    material, gray 128 and lighter may change; it cannot reach faces without texture coordinates. Face numbers are those
    of `mesh.faces`. A face may change together with a rim of GUTTER_TEXELS around it.
    """
    chosen, placed = _chosen(mesh, patch, base), has_usable_uv(mesh)
    if patch.mask is not None:
        chosen = chosen & placed
        if not chosen.any():
            raise Refused("a mesh with texture coordinates for a mask", "none", "name materials or faces instead")
    warnings = []
    missing = chosen & ~placed
    if missing.any():
        mesh = unwrap(mesh, missing, texels)
        warnings.append(
            f"{np.count_nonzero(missing)} of {len(missing)} faces have no texture coordinates of use: they are"
            " unwrapped (xatlas) and keep their colors"
        )
    mesh = whole_colors(mesh, chosen, texels)
    masks = _masks(mesh, chosen)
    if patch.mask is not None:
        image = _read_mask(Path(expand_path(patch.mask, base)))
        warnings += _other_size(image, masks)
        masks = tuple(mask & _stretched(image, mask.shape) for mask in masks)
    if not any(mask.any() for mask in masks):
        raise Refused("a mask that is white on some face", "none of that", "compare it with the texture coordinates")
    start = tuple(_texture(mesh, i) for i in range(len(masks)))
    if patch.start == "gray":
        start = tuple(np.where(mask[..., None], np.uint8(GRAY), old) for mask, old in zip(masks, start, strict=True))
    return Canvas(mesh, start, masks, (*warnings, *_doubts(mesh, chosen, masks)))


def _chosen(mesh: Mesh, patch: PatchSettings, base: Path) -> np.ndarray:
    """Which faces F the settings name."""
    if patch.materials or patch.faces is not None:
        return select_faces(mesh, patch.materials, patch.faces, base)
    return np.ones(len(mesh.faces), bool)


def select_faces(mesh: Mesh, materials: tuple[str, ...], faces: str | None, base: Path) -> np.ndarray:
    """Which faces F have a material of these names, or their number in that text file, whose path is relative to
    `base`.
    """
    names = [material.name for material in mesh.materials]
    for name in materials:
        if name not in names:
            raise Refused("the name of a material", f'"{name}"', spelling_hint(name, dict.fromkeys(names)))
    chosen = np.isin(mesh.face_material, [i for i, name in enumerate(names) if name in materials])
    if faces is not None:
        chosen |= _read_faces(Path(expand_path(faces, base)), len(chosen))
    return chosen


def _read_faces(path: Path, count: int) -> np.ndarray:
    """Which of `count` faces a text file names: one number, or a range a-b with both ends, per line; # starts a
    comment.
    """
    if not is_file(path):
        raise Refused("a file of face numbers", f"no file at {path}", "check the path")
    chosen = np.zeros(count, bool)
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.partition("#")[0].split("-")
        if not "".join(words).strip() and len(words) == 1:
            continue
        try:
            ends = [int(word) for word in words]
        except ValueError:
            ends = []
        if len(ends) not in (1, 2) or not 0 <= ends[0] <= ends[-1] < count:
            got = f'"{line.strip()[:40]}" in line {number} of {path.name}'
            raise Refused(f"a face number or a range a-b from 0 to {count - 1}", got, "mend that line")
        chosen[ends[0] : ends[-1] + 1] = True
    if not chosen.any():
        raise Refused("face numbers, one per line", f"none in {path.name}", "name some, or leave the file out")
    return chosen


def _read_mask(path: Path) -> np.ndarray:
    """The gray values of a mask as float H×W in 0..255."""
    if not is_file(path):
        raise Refused("a mask image", f"no file at {path}", "check the path")
    with open_image(path, "a mask image", "save it as PNG") as image:
        deep = image.mode.startswith("I")  # 16 bits: Pillow would clip them at 255 instead of scaling them
        gray = np.asarray(image, float) / 257 if deep else np.asarray(image.convert("L"), float)
    if gray.max() < 128:
        raise Refused("a mask with white where the texture may change", f"none in {path.name}", "paint it white there")
    return gray


def _other_size(gray: np.ndarray, masks: tuple[np.ndarray, ...]) -> list[str]:
    """A sentence where a mask is of another size than a texture that it is laid over."""
    sizes = dict.fromkeys(f"{m.shape[1]} × {m.shape[0]}" for m in masks if m.any() and m.shape != gray.shape)
    if not sizes:
        return []
    return [
        f"the mask of {gray.shape[1]} × {gray.shape[0]} pixels is laid over {' and '.join(sizes)} texels: a texel may"
        " change where the mean of what lies over it is light"
    ]


def _stretched(gray: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A mask over H×W texels, averaged where it is finer: where it is light."""
    from PIL import Image

    image, (height, width) = Image.fromarray(gray.astype(np.float32)), shape
    return np.asarray(image.resize((width, height), Image.Resampling.BOX)) >= 128


def whole_colors(mesh: Mesh, chosen: np.ndarray, texels: int = TEXELS) -> Mesh:
    """`mesh` with each material's color in its texture; one-colored ones get `texels`² where the `chosen` of its faces
    F may change.
    """

    def whole(index: int, material: Material) -> Material:
        table = codes_from_srgb(srgb_from_linear((LINEAR_FROM_CODE[:, None] * material.base_color_linear).clip(0, 1)))
        texture = np.full((1, 1, 3), 255, np.uint8) if material.texture_srgb is None else material.texture_srgb
        texture = np.stack([table[texture[..., channel], channel] for channel in range(3)], axis=-1)
        if texture.shape[:2] == (1, 1) and (chosen & (mesh.face_material == index)).any():
            texture = np.tile(texture, (texels, texels, 1))
        return Material(material.name, (1.0, 1.0, 1.0), texture)

    return replace(mesh, materials=tuple(whole(i, material) for i, material in enumerate(mesh.materials)))


def _masks(mesh: Mesh, chosen: np.ndarray) -> tuple[np.ndarray, ...]:
    """The texels of each material that chosen faces can show."""
    return tuple(
        coverage(_corners(mesh, chosen & (mesh.face_material == i)), _size(mesh, i), GUTTER_TEXELS) > 0
        for i in range(len(mesh.materials))
    )


def _corners(mesh: Mesh, faces: np.ndarray) -> np.ndarray:
    """Corners F×3×2 in texels of faces of one material."""
    index = mesh.face_material[faces][:1]
    return mesh.corner_uv[faces].astype(float) * (_size(mesh, index[0]) if len(index) else 1)


def _texture(mesh: Mesh, index: int) -> np.ndarray:
    return np.asarray(mesh.materials[index].texture_srgb)  # every material has one by now


def _size(mesh: Mesh, index: int) -> tuple[int, int]:
    height, width, _ = _texture(mesh, index).shape
    return width, height


def _doubts(mesh: Mesh, chosen: np.ndarray, masks: tuple[np.ndarray, ...]) -> list[str]:
    """What the user should know about the texels that may change."""
    repeated, palette, unnamed = _shares(mesh, chosen, masks)
    doubts = []
    if palette > _WORTH_SAYING:
        doubts.append(
            f"{palette:.0%} of the surface that may change takes its color from a few texels (a palette texture): each"
            " such part stays of one color, and one texel recolors all of them; unwrap the object anew for a pattern"
        )
    if repeated > _WORTH_SAYING:
        doubts.append(
            f"{repeated:.0%} of the surface that may change shows texels that show at another place too (mirrored or"
            " tiled): both places get the same pattern and cannot differ; unwrap the object anew if they should"
        )
    if unnamed > 0.01:
        doubts.append(f"{unnamed:.0%} of the surface changes too, although not named: it shows the same texels")
    if (mesh.corner_color_linear[chosen] != 1).any():
        doubts.append("vertex colors go on multiplying the texture: where they are dark, it stays dark")
    return doubts


def _shares(mesh: Mesh, chosen: np.ndarray, masks: tuple[np.ndarray, ...]) -> tuple[float, float, float]:
    """Shares of the surface: (repeated and palette, of what may change; changing although not chosen, of all).

    Of faces that lie on one another (a front and a back, as some programs export) one stands for all: they show
    one place.
    """
    area, single, placed = _areas(mesh), _first_of_its_place(mesh), has_usable_uv(mesh)
    may, repeated, palette, unnamed = np.zeros((4, len(area)))  # shares of each face
    for index, mask in enumerate(masks):
        mine = placed & (mesh.face_material == index)
        corners, size = _corners(mesh, mine), _size(mesh, index)
        inside, centers = texels_per_face(corners, mask)
        several = coverage(_corners(mesh, mine & single), size) > 1
        own = coverage(_corners(mesh, mine & chosen), size) > 0
        x, y = (np.floor(corners.mean(1)).astype(np.int64) % size).T
        may[mine] = np.where(centers > 0, inside / np.maximum(centers, 1), mask[y, x])
        repeated[mine] = texels_per_face(corners, several & mask)[0] / np.maximum(centers, 1)
        palette[mine] = may[mine] * _in_palette(y * size[0] + x, size, area[mine], centers == 0)
        unnamed[mine] = texels_per_face(corners, own & mask)[0] / np.maximum(centers, 1)
    changing = max(float(area[chosen] @ may[chosen]), 1e-300)
    return (
        float(area[chosen] @ repeated[chosen]) / changing,
        float(area[chosen] @ palette[chosen]) / changing,
        float(area[~chosen] @ unnamed[~chosen] / area.sum()),
    )


def _in_palette(texel: np.ndarray, size: tuple[int, int], area: np.ndarray, small: np.ndarray) -> np.ndarray:
    """Which faces are smaller than a texel in UV while that texel paints far more than its share of the surface."""
    painted = np.bincount(texel, np.where(small, area, 0.0))
    return small & (painted[texel] > _PALETTE * area.sum() / (size[0] * size[1]))


def _first_of_its_place(mesh: Mesh) -> np.ndarray:
    """Whether no face before this one has the same three corners in space."""
    first = np.unique(np.sort(position_numbers(mesh.vertices)[mesh.faces], axis=1), axis=0, return_index=True)[1]
    return np.isin(np.arange(len(mesh.faces)), first)


def _areas(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
