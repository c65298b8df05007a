"""Files that a mesh names, read and decoded, and warnings about what a mesh says.

In: names as a mesh writes them, paths or data URIs. Out: bytes of files, textures as pixels, and colors as light. All
but pictures must lie in the mesh's folder or below, links followed. Refused: a file that is missing, an image that
cannot be decoded, more bytes or texels than a mesh may have. As glTF says for its images, color profiles and
orientations of textures are not applied; alpha is dropped.
"""

import base64
import urllib.parse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import IMAGE_FORMATS, MAX_FILE_BYTES, is_file, open_image, read_file
from patchproof.mesh.mesh import Material, MeshPart

WHITE = (1.0, 1.0, 1.0)
GRAY = Material("unnamed", (0.21404114, 0.21404114, 0.21404114))  # sRGB 0.5, for an object without color
VERTEX_COLORS = Material("vertex colors", WHITE)
MOST_TEXELS = 300_000_000  # of all textures of a mesh: 900 MB; 17 of 4096 × 4096
Wrap = Literal["repeat", "mirror", "clamp"]
_MOST_PX = 8192  # of the side of a texture that is drawn out
_ROUNDING = 1e-4  # of coordinates beyond 0 to 1: less than a texel


class Assets:
    """A mesh file's `data`, the files beside it as far as they have been read, and the `warnings` of its reader."""

    def __init__(self, path: Path):
        self.path, self.data, self.warnings = path, read_file(path, "a mesh file"), dict[str, None]()
        self._files: dict[str | Path, bytes] = {}
        self._textures: dict[tuple[bytes, float, float], np.ndarray] = {}
        self._free_bytes, self._free_texels = MAX_FILE_BYTES, MOST_TEXELS

    @property
    def files(self) -> list[Path]:
        """The mesh file and the files beside it that have been read."""
        return [self.path, *(source for source in self._files if isinstance(source, Path))]

    @property
    def size(self) -> int:
        """The bytes of all files that have been read."""
        return len(self.data) + MAX_FILE_BYTES - self._free_bytes

    def say(self, warning: str) -> None:
        """Add a warning, unless it is there already."""
        self.warnings[warning] = None

    def find(self, name: str, folder: Path | None = None, is_picture: bool = False) -> Path | None:
        """Return the path of a file in `folder` or beside the mesh, or None; names may have %20 or backslashes."""
        name = name.strip()
        spellings = (name, name.replace("\\", "/"), urllib.parse.unquote(name))
        places = [place / each for place in (folder or self.path.parent, self.path.parent) for each in spellings]
        formats, inside = Image.registered_extensions() if is_picture else {}, self.path.parent.resolve()
        for path, real in ((path, path.resolve()) for path in places if is_file(path)):
            if formats.get(real.suffix.lower()) in IMAGE_FORMATS or real.is_relative_to(inside):
                return path
        return None

    def read(self, name: str, folder: Path | None = None, is_picture: bool = False) -> bytes:
        """Return the bytes of a named file or of a data URI; refused if there is no such file that may be opened."""
        source = name if name.startswith("data:") else self.find(name, folder, is_picture)
        if source is None:
            remedy = f"put it into {folder or self.path.parent}"
            raise Refused(f"the file {name}, which {self.path.name} names", "no such file in its folder", remedy)
        if source not in self._files:
            if isinstance(source, Path):
                data = read_file(source, "a file of a mesh", max_bytes=self._free_bytes)
                self._free_bytes -= len(data)
            else:
                data = base64.b64decode(source.partition(";base64,")[2])
            self._files[source] = data
        return self._files[source]

    def texture(self, data: bytes, name: str, base: float = 0.0, gain: float = 1.0) -> np.ndarray:
        """Decode an image, once, as uint8 H×W×3 of `base` + `gain` · value, where 1 is white; 16 bits are cut to 8."""
        if (data, base, gain) not in self._textures:
            expected = f"the texture {name} of {self.path.name} as an image that can be read"
            with open_image(data, expected, "export it again as PNG or JPEG") as image:
                if not self.has_room(image.width * image.height):
                    expected = f"textures of {self.path.name} with at most {MOST_TEXELS // 10**6} million pixels in all"
                    raise Refused(expected, f"{image.width} × {image.height} more in {name}", "export smaller ones")
                if image.mode.startswith("I"):  # Pillow would clip 16 bits at 255 instead of scaling them
                    image = Image.fromarray((np.asarray(image) >> 8).clip(0, 255).astype(np.uint8))
                image = image.convert("RGB")
                if (base, gain) != (0, 1):
                    curve = 255 * base + gain * np.arange(256, dtype=np.float32)
                    image = image.point(curve.clip(0, 255).round().astype(int).tolist() * 3)
                self._textures[data, base, gain] = np.asarray(image)
        return self._textures[data, base, gain]

    def has_room(self, texels: int) -> bool:
        """Reserve texels of the number that a mesh may have; False if fewer remain."""
        has_room = texels <= self._free_texels
        self._free_texels -= texels if has_room else 0
        return has_room

    def gray(self) -> Material:
        """Return the material of faces that have none, and say so."""
        self.say("faces without a material color are taken as gray 0.5")
        return GRAY

    def finite_uv(self, uv: np.ndarray) -> np.ndarray:
        """Return texture coordinates V×2 with NaN and infinity replaced by 0, which is warned of."""
        finite = np.all(np.abs(uv) < 1e30, axis=1)  # float32 holds it
        if not finite.all():
            self.say(f"{np.count_nonzero(~finite)} texture coordinates are not numbers and are taken as 0")
        return np.where(finite[:, None], uv, 0.0)

    def linear_colors(self, colors: np.ndarray, is_srgb: bool) -> np.ndarray:
        """Return colors N×3 of 0 to 1, or of 0 to 255 in files that do not say so, as linear light within 0 to 1."""
        broken = ~np.all(np.isfinite(colors), axis=1)
        if broken.any():
            self.say(f"{np.count_nonzero(broken)} vertex colors are not numbers and are taken as gray 0.5")
        if is_srgb and np.max(colors[~broken], initial=0.0) > 1:
            self.say("vertex colors above 1 are taken as 0 to 255")
            colors = colors / 255
        colors = np.clip(np.where(broken[:, None], 0.0, colors), 0.0, 1.0)
        return np.where(broken[:, None], GRAY.base_color_linear, linear_from_srgb(colors) if is_srgb else colors)


def draw_out_textures(
    parts: Sequence[MeshPart], wraps: Mapping[Material, tuple[Wrap, Wrap]], assets: Assets
) -> list[MeshPart]:
    """Return parts whose textures all repeat: those that do not, by their (u, v) in `wraps`, are extended as far as
    their coordinates reach.
    """
    drawn = {id(part): part for part in parts}
    for material, modes in wraps.items():
        texture, scale, shift = material.texture_srgb, np.ones(2), np.zeros(2)
        owners = [(part, part.uv) for part in parts if part.material is material and part.uv is not None]
        if texture is None or not owners:
            continue
        seen = np.concatenate([uv[np.unique(part.faces)] for part, uv in owners])
        for i, (mode, low, high) in enumerate(zip(modes, seen.min(0), seen.max(0), strict=True)):
            if mode == "repeat" or (low >= -_ROUNDING and high <= 1 + _ROUNDING):
                continue
            size, pad = texture.shape[1 - i], np.zeros((3, 2))
            pad[1 - i] = (0, size) if mode == "mirror" else np.ceil(1 + size * np.maximum(0, [-low, high - 1]))
            total = size + pad.sum()
            if total > _MOST_PX or not assets.has_room(int(total) * texture.shape[i]):
                got = f"{total:.0f} texels instead of {size}"
                assets.say(f"the texture of {material.name} is repeated, not {mode}ed: that would take {got}")
                continue
            texture = np.pad(texture, pad.astype(int), "symmetric" if mode == "mirror" else "edge")
            scale[i], shift[i] = size / total, pad[1 - i, 0] / total
        if texture is not material.texture_srgb:
            larger = replace(material, texture_srgb=texture)
            for part, uv in owners:
                drawn[id(part)] = replace(part, material=larger, uv=uv * scale + shift)
    return list(drawn.values())
