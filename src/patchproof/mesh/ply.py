"""Read PLY files, as text or binary, as one part in the file's axes.

In: a file and its texture. Out: its faces, cut into triangles, with the coordinates and colors of their corners.
Colors are taken as sRGB, as exporters write them; those of faces go before those of vertices, a texture before both.
Refused: several textures.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.validation import summarize_names
from patchproof.mesh.assets import VERTEX_COLORS, WHITE, Assets
from patchproof.mesh.mesh import Material, MeshPart
from patchproof.mesh.polygons import triangulate

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"}
_TYPES |= {"double": "f8", "float64": "f8"}
_HEAD = re.compile(rb"ply\r?\n.*?\nend_header[ \t]*\r?\n", re.DOTALL)
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_RGBA = ("red", "green", "blue", "alpha")


class _Element:
    """One kind of element: its properties (name, numpy's type of values, and of a list's length if it is a list), and
    the values of each, as arrays or as lists of lists of unequal lengths.
    """

    def __init__(self, count: int):
        self.count = count
        self.properties: list[tuple[str, str, str]] = []
        self.values: dict[str, Any] = {}

    def table(self, names: Sequence[str]) -> np.ndarray | None:
        """Return the columns of these names as floats; None if one is missing."""
        columns = [self.values[name] for name in names if name in self.values]
        return np.column_stack(columns).astype(float) if len(columns) == len(names) else None

    def colors(self, assets: Assets) -> np.ndarray | None:
        """Return linear colors N×3, or None."""
        kinds = {name: np.dtype(kind) for name, kind, _ in self.properties if name in _RGBA}
        table = self.table(_RGBA[: max(3, len(kinds))])
        if table is None:
            return None
        table /= [1 if kinds[name].kind == "f" else np.iinfo(kinds[name]).max for name in _RGBA[: len(kinds)]]
        if np.any(table[:, 3:] < 1):
            assets.say("transparent materials are drawn opaque")
        return assets.linear_colors(table[:, :3], is_srgb=True)

    def read(self, data: bytes, start: int, is_text: bool) -> int:
        """Read the values from byte `start` on, all of them float64 if the file is text; return their end."""
        plan = [
            (n, "f8", length_kind and "f8") if is_text else (n, k, length_kind) for n, k, length_kind in self.properties
        ]
        fields: list[tuple] = []  # of one row, if all lists are as long as those of the first
        for name, kind, length_kind in plan if self.count else ():
            length = ()
            if length_kind:
                length = (int(np.frombuffer(data, length_kind, 1, start + np.dtype(fields).itemsize)[0]),)
                fields.append((f"length of {name}", length_kind))
            fields.append((name, kind, length))
        row = np.dtype(fields)
        end = start + self.count * row.itemsize
        if end <= len(data):
            rows = np.frombuffer(data, row, self.count if fields else 0, start)
            if all(np.all(rows[name] == rows[name][:1]) for name in row.names or () if name.startswith("length of ")):
                self.values = {name: rows[name] for name, *_ in plan if fields}
                return end
        self.values = {name: [] for name, *_ in plan}
        for _ in range(self.count):
            for name, kind, length_kind in plan:
                length = 1
                if length_kind:
                    length = max(0, int(np.frombuffer(data, length_kind, 1, start)[0]))
                    start += np.dtype(length_kind).itemsize
                self.values[name].append(np.frombuffer(data, kind, length, start))
                start += length * np.dtype(kind).itemsize
        return start


def read_ply(assets: Assets) -> list[MeshPart]:
    """Read a PLY file as one part, or none if it has no faces."""
    elements, textures = _read(assets.data)
    vertex, face = (elements.pop(name, _Element(0)) for name in ("vertex", "face"))
    others = [name for name, element in elements.items() if element.count]
    if others:
        assets.say(f"left out of {assets.path.name}: {summarize_names(others)}")
    if len(textures) > 1:
        raise Refused("a PLY file with one texture", summarize_names(textures), "export the mesh as OBJ or GLB")
    polygons = face.values.get("vertex_indices", face.values.get("vertex_index", ()))
    points = vertex.table("xyz")
    if points is None or not len(polygons):
        return []
    corners, lengths = _joined(polygons)
    corners = corners.astype(np.int64)
    if lengths.min() < 3 or corners.min() < 0 or corners.max() >= len(points):
        got = f"{lengths.min()} corners and indices {corners.min()} to {corners.max()} in {assets.path.name}"
        raise Refused(f"faces with at least 3 corners and indices 0 to {len(points) - 1}", got, "export it again")
    uv = vertex.table(next((names for names in _UV if names[0] in vertex.values), _UV[0]))
    normals, colors = vertex.table(("nx", "ny", "nz")), vertex.colors(assets)
    face_colors, corner_uv = face.colors(assets), face.values.get("texcoord")
    if face_colors is not None or corner_uv is not None:  # every face gets corners of its own
        normals, uv, colors = (None if table is None else table[corners] for table in (normals, uv, colors))
        points, corners = points[corners], np.arange(len(corners))
        colors = colors if face_colors is None else np.repeat(face_colors, lengths, axis=0)
        uv = uv if corner_uv is None else _joined(corner_uv)[0].reshape(len(corners), 2)
    uv = None if uv is None else assets.finite_uv(uv) * (1, -1) + (0, 1)
    material = VERTEX_COLORS if colors is not None else None
    if textures and uv is None:
        assets.say("a texture without texture coordinates is left out")
    elif textures:
        material = Material("unnamed", WHITE, assets.texture(assets.read(textures[0]), textures[0]))
        if colors is not None:
            assets.say("vertex colors are left out where there is a texture")
            colors = None
    return [MeshPart(points, triangulate(corners, lengths, points), material or assets.gray(), uv, normals, colors)]


def _joined(lists: np.ndarray | list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of lists, one list after the other, and the lists' lengths."""
    if isinstance(lists, np.ndarray):
        return lists.reshape(-1), np.full(len(lists), lists.shape[1])
    return np.concatenate(lists), np.array([*map(len, lists)])


def _read(data: bytes) -> tuple[dict[str, _Element], list[str]]:
    """Return the elements with their values, and the names of textures."""
    head = _HEAD.match(data)
    if not head:
        raise ValueError("it has no header")
    elements: dict[str, _Element] = {}
    order, textures, element = "", list[str](), _Element(0)
    for line in head[0].decode("utf-8", errors="replace").splitlines():
        match line.split():
            case ["format", form, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
            case ["element", name, count]:
                element = elements[name] = _Element(int(count))
            case ["property", "list", length, kind, name]:
                element.properties.append((name, order + _TYPES[kind], order + _TYPES[length]))
            case ["property", kind, name]:
                element.properties.append((name, order + _TYPES[kind], ""))
            case ["comment", key, *_] if key.lower() == "texturefile":
                textures.append(line.partition(key)[2].strip())
    start = head.end()
    if not order:
        data, start = np.array([float(word) for word in data[start:].split()]).tobytes(), 0
    for element in elements.values():
        start = element.read(data, start, not order)
    return elements, list(dict.fromkeys(textures))
