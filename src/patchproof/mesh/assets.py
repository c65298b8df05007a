"""Files that a mesh names: material libraries, textures, buffers.

In: names as a mesh writes them. Out: the bytes of files beside the mesh. Missing and broken files are remembered,
because trimesh does not report them.
"""

from __future__ import annotations

import io
import urllib.parse
from pathlib import Path

from patchproof.base.input import is_file, readable_formats

MOST_BYTES = 1 << 30  # of one file


class Assets:
    """Reads files that a mesh names from its folder and remembers missing and broken ones; trimesh's `resolver`."""

    def __init__(self, mesh: Path):
        self.folder, self.file_name = mesh.parent, mesh.name
        self.missing, self.broken, self.files = [], [], [mesh]

    def get(self, name: str) -> bytes:
        """Return the bytes of a file."""
        name = str(name).strip()
        if name.startswith("-"):  # map_Kd takes options before the name
            name = name.split()[-1]
        for spelling in (name, name.replace("\\", "/"), urllib.parse.unquote(name)):
            if is_file(self.folder / spelling):
                if (self.folder / spelling).stat().st_size > MOST_BYTES:
                    raise ValueError(f"{spelling} is too large")
                data = (self.folder / spelling).read_bytes()
                self.files.append(self.folder / spelling)
                if not spelling.lower().endswith((".mtl", ".bin")) and not _is_image(data):
                    self.broken.append(name)
                return data
        self.missing.append(name)
        raise FileNotFoundError(name)

    __getitem__ = get


def _is_image(data: bytes) -> bool:
    """True if Pillow knows the format and finds no error, as far as it can tell without decoding."""
    from PIL import Image

    try:
        Image.open(io.BytesIO(data), formats=readable_formats()).verify()
    except Exception:  # Pillow's readers raise many types of error
        return False
    return True
