"""Small glTF files, written without a library."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
COMPONENTS = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}
SQUARE = np.float32([[0, 0, 0], [4, 0, 0], [4, 2, 0], [0, 2, 0]])
SQUARE_UV = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])
SQUARE_FACES = np.uint16([0, 1, 2, 0, 2, 3])[:, None]


def data_uri(pixels: np.ndarray, format_name: str = "PNG") -> str:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format_name)
    return f"data:image/{format_name.lower()};base64," + base64.b64encode(stream.getvalue()).decode()


class GltfFile:
    """A glTF tree, begun with one node of one mesh, whose arrays are added to one buffer."""

    def __init__(self, **tree: Any):
        self.blob = b""
        self.tree = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "bufferViews": [],
            "accessors": [],
            **tree,
        }

    def view(self, data: bytes, **keys: Any) -> int:
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **keys})
        self.blob += data + b"\0" * (-len(data) % 4)
        return len(self.tree["bufferViews"]) - 1

    def add(self, array: np.ndarray, **keys: Any) -> int:
        """Add an accessor of an array count×width; its number."""
        accessor = {"componentType": COMPONENTS[array.dtype.char], "count": len(array), "type": TYPES[array.shape[1]]}
        self.tree["accessors"].append({"bufferView": self.view(array.tobytes()), **accessor, **keys})
        return len(self.tree["accessors"]) - 1

    def primitive(self, *, mesh: int = 0, **keys: Any) -> dict:
        self.tree["meshes"][mesh]["primitives"].append(keys)
        return keys

    def square(self, uv: np.ndarray = SQUARE_UV, texture: np.ndarray | None = None, **keys: Any) -> dict:
        """Add a square of 4×2, textured if there are pixels; `keys` of its primitive."""
        if texture is not None:
            self.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
            self.tree |= {"textures": [{"source": 0}], "images": [{"uri": data_uri(texture)}]}
            keys = {"material": 0, **keys}
        attributes = {"POSITION": self.add(SQUARE), "TEXCOORD_0": self.add(uv)}
        return self.primitive(attributes=attributes, indices=self.add(SQUARE_FACES), **keys)

    def write(self, path: Path) -> Path:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        buffers = [{"byteLength": len(self.blob), "uri": uri}]
        path.write_text(json.dumps({"buffers": buffers, **self.tree}), encoding="utf-8")
        return path
