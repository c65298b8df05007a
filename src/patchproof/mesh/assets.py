"""Files that a mesh names, read and decoded, and warnings about what a mesh says.

In: names as a mesh writes them, paths or data URIs. Out: bytes of files beside the mesh, textures as pixels, and colors
as light. Refused: a file that is missing, and an image that cannot be decoded. As glTF says for its images, color
profiles and orientations of textures are not applied; alpha is dropped.
"""

from __future__ import annotations

import base64
import urllib.parse
from pathlib import Path

import numpy as np

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, open_image, read_file
from patchproof.mesh.mesh import Material

WHITE = (1.0, 1.0, 1.0)
GRAY = Material("unnamed", (0.21404114, 0.21404114, 0.21404114))  # sRGB 0.5, for an object without color
VERTEX_COLORS = Material("vertex colors", WHITE)


class Assets:
    """A mesh file's `data`, the files beside it as far as they have been read, and the `warnings` of its reader."""

    def __init__(self, path: Path):
        self.path, self.data = path, read_file(path, "a mesh file")
        self.warnings: dict[str, None] = {}
        self._files: dict[str | Path, bytes] = {}
        self._textures: dict[bytes, np.ndarray] = {}

    @property
    def files(self) -> list[Path]:
        """The mesh file and the files beside it that have been read."""
        return [self.path, *(source for source in self._files if isinstance(source, Path))]

    def say(self, warning: str) -> None:
        """Add a warning, unless it is there already."""
        self.warnings[warning] = None

    def find(self, name: str, folder: Path | None = None) -> Path | None:
        """Return the path of a file in `folder` or beside the mesh, or None; names may have %20 or backslashes."""
        spellings = (name.strip(), name.strip().replace("\\", "/"), urllib.parse.unquote(name.strip()))
        places = [
            place / spelling for place in (folder or self.path.parent, self.path.parent) for spelling in spellings
        ]
        return next(filter(is_file, places), None)

    def read(self, name: str, folder: Path | None = None) -> bytes:
        """Return the bytes of a named file or of a data URI; refused if there is no such file."""
        source = name if name.startswith("data:") else self.find(name, folder)
        if source is None:
            remedy = f"put it into {folder or self.path.parent}"
            raise Refused(f"the file {name}, which {self.path.name} names", "no such file", remedy)
        if source not in self._files:
            is_path = isinstance(source, Path)
            data = (
                read_file(source, "a file of a mesh") if is_path else base64.b64decode(source.partition(";base64,")[2])
            )
            self._files[source] = data
        return self._files[source]

    def texture(self, data: bytes, name: str) -> np.ndarray:
        """Decode an image, once, as uint8 H×W×3; 16 bits are cut to 8."""
        if data not in self._textures:
            expected = f"the texture {name} of {self.path.name} as an image that can be read"
            with open_image(data, expected, "export it again as PNG or JPEG") as image:
                if image.mode.startswith("I"):  # Pillow would clip 16 bits at 255 instead of scaling them
                    pixels = np.repeat((np.asarray(image) >> 8).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
                else:
                    pixels = np.asarray(image.convert("RGB"))
            self._textures[data] = pixels
        return self._textures[data]

    def gray(self) -> Material:
        """Return the material of faces that have none, and say so."""
        self.say("faces without a material color are taken as gray 0.5")
        return GRAY

    def finite_uv(self, uv: np.ndarray) -> np.ndarray:
        """Return texture coordinates V×2 with 0 in place of what is not a number, and a warning."""
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
