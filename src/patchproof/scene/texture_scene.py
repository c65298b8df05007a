"""A scene in which the object's own texture is optimized, whole or under a mask; no piece is put on it.

In: a mesh and the `[patch]` table of kind "texture" (everything) or "masked" (an image over UV space, material names,
or a file of face numbers). Out: a scene with a `Canvas`: textures, the texels that may change, the mesh that shows
them. Each material gets one texture that is its whole color: base colors are multiplied in (to 8-bit rounding the
object looks as before), so that texels reach every color that paint can have. Faces without texture coordinates are
unwrapped first (see `unwrap`). Warnings tell of texels that show at several places, palettes, vertex colors that still
multiply, and faces that change although nobody named them. Left out on purpose: improving texture coordinates; resizing
textures.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, open_image, read_text
from patchproof.base.settings import PatchSettings
from patchproof.base.validation import expand_path, spelling_hint
from patchproof.mesh.mesh import Material, Mesh, position_numbers
from patchproof.mesh.unwrap import coverage, has_usable_uv, texels_per_face, unwrap
from patchproof.scene.interface import SceneSource
from patchproof.scene.mesh_scene import MeshScene, load_bare

TEXELS = 1024  # side of a new texture: 0.7 mm per texel over a cube of 300 mm
GUTTER_TEXELS = 1.5  # every texel that a face touches and one more, for bilinear look-ups within the face
GRAY = 128  # sRGB 0.5
_WARNING_SHARE = 0.05  # share of the surface
# a face with this many times fewer texels than its even share takes its color from a palette, not from a picture
_PALETTE_FACTOR = 16


@dataclass(frozen=True)
class Canvas:
    """The object as it is rendered, its textures at the start, and the texels that may change."""

    mesh: Mesh  # the bare object; every material has a texture and base color 1
    start_srgb: tuple[np.ndarray, ...]  # uint8 H×W×3 per material
    mask: tuple[np.ndarray, ...]  # bool H×W per material: may change
    warnings: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The materials' names in the mesh file; they may repeat."""
        return tuple(material.name for material in self.mesh.materials)


@dataclass(frozen=True)
class TextureScene(MeshScene):
    """An object of which some texels may change."""

    canvas: Canvas
    LEARNS_TEXTURE = True

    def object_canvas(self) -> Canvas:
        """Implement `Scene.object_canvas`."""
        return self.canvas


def build(source: SceneSource) -> TextureScene:
    """Build the scene of settings whose `patch.kind` is "texture" or "masked"."""
    bare = load_bare(source)
    canvas = texture_canvas(bare.mesh, source.settings.patch, source.base)
    fields = {"mesh": canvas.mesh, "canvas": canvas, "notes": (*bare.notes, *canvas.warnings)}
    return TextureScene(**vars(bare) | fields)


def texture_canvas(mesh: Mesh, patch: PatchSettings, base: Path, texels: int = TEXELS) -> Canvas:
    """Return the canvas of `mesh` for patch kinds "texture" and "masked"; files are relative to `base`.

    `texels` is the side of new textures. A mask image is stretched over each material's UV square; where gray is 128 or
    lighter, faces with texture coordinates may change. Face numbers are those of `mesh.faces`. A face may change
    together with a rim of GUTTER_TEXELS around it.
    """
    chosen_faces, has_uv = np.ones(len(mesh.faces), bool), has_usable_uv(mesh)
    if patch.materials or patch.faces is not None:
        chosen_faces = select_faces(mesh, patch.materials, patch.faces, base)
    if patch.mask is not None:
        chosen_faces = chosen_faces & has_uv
        if not chosen_faces.any():
            got = f"{len(has_uv)} faces without any"
            raise Refused("a mesh with texture coordinates for a mask", got, "name materials or faces instead")
    warnings = []
    without_uv = chosen_faces & ~has_uv
    if without_uv.any():
        mesh = unwrap(mesh, without_uv, texels)
        warnings.append(
            f"{np.count_nonzero(without_uv)} of {len(without_uv)} faces have no texture coordinates of use: they are"
            " unwrapped (xatlas) and keep their colors"
        )
    mesh = bake_base_colors(mesh, chosen_faces, texels)
    shown = (_corners(mesh, chosen_faces & (mesh.face_material == i)) for i in range(len(mesh.materials)))
    masks = tuple(coverage(corners, _size(mesh, i), GUTTER_TEXELS) > 0 for i, corners in enumerate(shown))
    if patch.mask is not None:
        from PIL import Image

        image = _read_mask(Path(expand_path(patch.mask, base)))
        picture, (height, width) = Image.fromarray(image.astype(np.float32)), image.shape
        for texels_high, texels_wide in dict.fromkeys(m.shape for m in masks if m.any() and m.shape != image.shape):
            warnings.append(
                f"the mask of {width} × {height} pixels is laid over {texels_wide} × {texels_high} texels: a texel may"
                " change where the mean of what lies over it is light"
            )
        # stretched over the texels, averaged where it is finer
        stretched = (np.asarray(picture.resize(mask.shape[::-1], Image.Resampling.BOX)) for mask in masks)
        masks = tuple(mask & (gray >= 128) for mask, gray in zip(masks, stretched, strict=True))
    if not any(mask.any() for mask in masks):
        got = f"a mask that covers none of {np.count_nonzero(chosen_faces)} faces"
        raise Refused("a mask that covers a face", got, "compare it with the texture coordinates")
    start = tuple(_texture(mesh, i) for i in range(len(masks)))
    if patch.start == "gray":
        start = tuple(np.where(mask[..., None], np.uint8(GRAY), old) for mask, old in zip(masks, start, strict=True))
    return Canvas(mesh, start, masks, (*warnings, *_texel_warnings(mesh, chosen_faces, masks)))


def select_faces(mesh: Mesh, materials: tuple[str, ...], faces: str | None, base: Path) -> np.ndarray:
    """Return which faces F have one of these materials or a number in the text file `faces`, relative to `base`."""
    names = [material.name for material in mesh.materials]
    for name in materials:
        if name not in names:
            raise Refused("the name of a material", f'"{name}"', spelling_hint(name, dict.fromkeys(names)))
    chosen_faces = np.isin(mesh.face_material, [i for i, name in enumerate(names) if name in materials])
    if faces is not None:
        chosen_faces |= _read_faces(Path(expand_path(faces, base)), len(chosen_faces))
    return chosen_faces


def _read_faces(path: Path, count: int) -> np.ndarray:
    """Return which of `count` faces a text file names: per line a number or a range a-b with both ends; # comments."""
    chosen_faces = np.zeros(count, bool)
    for number, line in enumerate(read_text(path, "a file of face numbers").splitlines(), 1):
        words = line.partition("#")[0].split("-")
        if not "".join(words).strip() and len(words) == 1:
            continue
        try:
            ends = [int(word) for word in words]
        except ValueError:
            ends = []
        if len(ends) not in (1, 2) or not 0 <= ends[0] <= ends[-1] < count:
            got = f'"{line.strip()[:40]}" in line {number} of {path.name}'
            raise Refused(f"a face number or a range a-b from 0 to {count - 1}", got, "correct that line")
        chosen_faces[ends[0] : ends[-1] + 1] = True
    if not chosen_faces.any():
        raise Refused("face numbers, one per line", f"no number in {path.name}", "add some, or leave the file out")
    return chosen_faces


def _read_mask(path: Path) -> np.ndarray:
    """Return the gray values of a mask, upright, as float H×W in 0..255."""
    from PIL import ImageOps

    if not is_file(path):
        raise Refused("a mask image", f"no file at {path}", "check the path")
    with open_image(path, "a mask image", "save it as PNG") as image:
        ImageOps.exif_transpose(image, in_place=True)
        is_16_bit = image.mode.startswith("I")  # 16 bits: Pillow would clip them at 255 instead of scaling them
        gray = np.asarray(image, float) / 257 if is_16_bit else np.asarray(image.convert("L"), float)
    if gray.max() < 128:
        got = f"no lighter gray than {gray.max():.0f} of 255 in {path.name}"
        raise Refused("a mask with white where the texture may change", got, "paint it white there")
    return gray


def bake_base_colors(mesh: Mesh, chosen_faces: np.ndarray, texels: int = TEXELS) -> Mesh:
    """Put each material's color into its texture; a single color becomes `texels`² if `chosen_faces` show it."""

    def with_base_color(index: int, material: Material) -> Material:
        table = codes_from_srgb(srgb_from_linear((LINEAR_FROM_CODE[:, None] * material.base_color_linear).clip(0, 1)))
        texture = np.full((1, 1, 3), 255, np.uint8) if material.texture_srgb is None else material.texture_srgb
        texture = np.stack([table[texture[..., channel], channel] for channel in range(3)], axis=-1)
        if texture.shape[:2] == (1, 1) and (chosen_faces & (mesh.face_material == index)).any():
            texture = np.tile(texture, (texels, texels, 1))
        return Material(material.name, (1.0, 1.0, 1.0), texture)

    return replace(mesh, materials=tuple(with_base_color(i, material) for i, material in enumerate(mesh.materials)))


def _corners(mesh: Mesh, faces: np.ndarray) -> np.ndarray:
    """Return corners F×3×2 in texels of faces of one material."""
    index = mesh.face_material[faces][:1]
    return mesh.corner_uv[faces].astype(float) * (_size(mesh, index[0]) if len(index) else 1)


def _texture(mesh: Mesh, index: int) -> np.ndarray:
    return np.asarray(mesh.materials[index].texture_srgb)  # every material has one by now


def _size(mesh: Mesh, index: int) -> tuple[int, int]:
    height, width, _ = _texture(mesh, index).shape
    return width, height


def _texel_warnings(mesh: Mesh, chosen_faces: np.ndarray, masks: tuple[np.ndarray, ...]) -> list[str]:
    """Return warnings about the texels that may change, with their shares of the surface."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    # a front and a back with the same three corners in space, as some programs export them, show one place
    first = np.unique(np.sort(position_numbers(mesh.vertices)[mesh.faces], axis=1), axis=0, return_index=True)[1]
    first_of_place, has_uv = np.isin(np.arange(len(area)), first), has_usable_uv(mesh)
    changeable, repeated, palette, unnamed = np.zeros((4, len(area)))  # shares of each face
    for index, mask in enumerate(masks):
        faces = has_uv & (mesh.face_material == index)
        corners, size = _corners(mesh, faces), _size(mesh, index)
        inside, centers = texels_per_face(corners, mask)
        several = coverage(_corners(mesh, faces & first_of_place), size) > 1
        of_chosen = coverage(_corners(mesh, faces & chosen_faces), size) > 0
        x, y = (np.floor(corners.mean(1)).astype(np.int64) % size).T
        changeable[faces] = np.where(centers > 0, inside / np.maximum(centers, 1), mask[y, x])
        repeated[faces] = texels_per_face(corners, several & mask)[0] / np.maximum(centers, 1)
        texels = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 2
        has_few = texels * _PALETTE_FACTOR * area.sum() < area[faces] * np.prod(size)
        palette[faces] = changeable[faces] * (has_few & (centers == 0))
        unnamed[faces] = texels_per_face(corners, of_chosen & mask)[0] / np.maximum(centers, 1)
    changing = max(float(area[chosen_faces] @ changeable[chosen_faces]), 1e-300)
    warnings = []
    if (share := float(area[chosen_faces] @ palette[chosen_faces]) / changing) > _WARNING_SHARE:
        warnings.append(
            f"{share:.0%} of the surface that may change takes its color from a few texels (a palette texture): each"
            " such part keeps a single color, and one texel recolors several; unwrap the object again for a pattern"
        )
    if (share := float(area[chosen_faces] @ repeated[chosen_faces]) / changing) > _WARNING_SHARE:
        warnings.append(
            f"{share:.0%} of the surface that may change shows texels that show at another place too (mirrored or"
            " tiled): both places get the same pattern and cannot differ; unwrap the object again if they should"
        )
    if (share := float(area[~chosen_faces] @ unnamed[~chosen_faces]) / area.sum()) > 0.01:
        warnings.append(f"{share:.0%} of the surface changes too, although not named: it shows the same texels")
    if (mesh.corner_color_linear[chosen_faces] != 1).any():
        warnings.append("vertex colors still multiply the texture: where they are dark, it stays dark")
    return warnings
