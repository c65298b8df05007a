"""Files that a mesh names: material libraries, textures, buffers.

In: names as a mesh writes them. Out: bytes, looked up beside it; what is missing or broken is remembered, since trimesh
keeps silent about it.
"""

from __future__ import annotations

import io
import urllib.parse
from pathlib import Path

from patchproof.base.input import is_file, readable_formats

MOST_BYTES = 1 << 30  # of one file


class Assets:
    """Files that a mesh names, looked up beside it; remembers the missing and broken ones. trimesh's `resolver`."""

    def __init__(self, mesh: Path):
        self.folder, self.file_name = mesh.parent, mesh.name
        self.missing, self.broken = [], []

    def get(self, name: str) -> bytes:
        """The bytes of a file."""
        name = str(name).strip()
        if name.startswith("-"):  # map_Kd takes options before the name
            name = name.split()[-1]
        for spelled in (name, name.replace("\\", "/"), urllib.parse.unquote(name)):
            if is_file(self.folder / spelled):
                if (self.folder / spelled).stat().st_size > MOST_BYTES:
                    raise ValueError(f"{spelled} is too large")
                data = (self.folder / spelled).read_bytes()
                if not spelled.lower().endswith((".mtl", ".bin")) and not _is_image(data):
                    self.broken.append(name)
                return data
        self.missing.append(name)
        raise FileNotFoundError(name)

    __getitem__ = get


def _is_image(data: bytes) -> bool:
    """Whether Pillow knows the format and finds it in order, as far as that can be told without decoding."""
    from PIL import Image

    try:
        Image.open(io.BytesIO(data), formats=readable_formats()).verify()
    except Exception:  # Pillow's readers raise whatever they stumble over
        return False
    return True
