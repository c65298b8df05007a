"""Read PLY files, as text or binary, as one part in the file's axes.

In: a file and its texture. Out: its faces, cut into triangles, with the coordinates and colors of their corners.
Colors are taken as sRGB, as exporters write them; those of faces go before those of vertices, a texture before both.
Refused: several textures.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.validation import summarize_names
from patchproof.mesh.assets import VERTEX_COLORS, WHITE, Assets
from patchproof.mesh.mesh import Material, MeshPart, triangulate

_NAMES = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64".split()
_TYPES: dict[str, str] = dict(zip(_NAMES, "i1 u1 i2 u2 i4 u4 f4 f8".split() * 2, strict=True))
_HEAD = re.compile(rb"ply\r?\n.*?\nend_header[ \t]*\r?\n", re.DOTALL)
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_RGBA = ("red", "green", "blue", "alpha")


class _Element:
    """One kind of element: properties (name, numpy types of values and of a list's length, or ""), and their values."""

    def __init__(self, count: int):
        self.count, self.properties, self.values = count, list[tuple[str, str, str]](), dict[str, Any]()

    def table(self, names: Sequence[str]) -> np.ndarray | None:
        """Return the columns of these names as floats; None if one is missing."""
        has_all = {*names} <= self.values.keys()
        return np.column_stack([self.values[name] for name in names]).astype(float) if has_all else None

    def colors(self, assets: Assets) -> np.ndarray | None:
        """Return linear colors N×3, or None."""
        kinds = {name: np.dtype(kind) for name, kind, _ in self.properties if name in _RGBA}
        if (table := self.table(_RGBA[: max(3, len(kinds))])) is None:
            return None
        table /= [1 if kinds[name].kind == "f" else np.iinfo(kinds[name]).max for name in _RGBA[: len(kinds)]]
        if np.any(table[:, 3:] < 1):
            assets.say("transparent materials are drawn opaque")
        return assets.linear_colors(table[:, :3], is_srgb=True)

    def read(self, data: bytes, start: int, is_text: bool) -> int:
        """Read the values from byte `start` on, all of them float64 if the file is text; return their end."""
        plan = [(name, "f8", size and "f8") if is_text else (name, kind, size) for name, kind, size in self.properties]
        if self.count < 1 or not plan:
            return start
        fields: list[tuple] = []  # of one row, if all lists are as long as those of the first
        for (name, kind, size), first in zip(plan, _row(data, start, plan)[0], strict=True):
            fields += [(f"length of {name}", size), (name, kind, first.shape)] if size else [(name, kind)]
        row = np.dtype(fields)
        if (end := start + self.count * row.itemsize) <= len(data):
            rows = np.frombuffer(data, row, self.count, start)
            if all(np.all(rows[f"length of {name}"] == rows[f"length of {name}"][0]) for name, _, size in plan if size):
                self.values = {name: rows[name] for name, *_ in plan}
                return end
        table = []
        for _ in range(self.count):
            values, start = _row(data, start, plan)
            table.append(values)
        self.values = {name: column for (name, *_), column in zip(plan, zip(*table, strict=True), strict=True)}
        return start


def _row(data: bytes, start: int, plan: list[tuple[str, str, str]]) -> tuple[list[np.ndarray], int]:
    """Return the values of each property of one element, and their end."""
    values = []
    for _, kind, size in plan:
        length = 1
        if size:
            length, start = max(0, int(np.frombuffer(data, size, 1, start)[0])), start + np.dtype(size).itemsize
        values.append(np.frombuffer(data, kind, length, start))
        start += values[-1].nbytes
    return values, start


def read_ply(assets: Assets) -> list[MeshPart]:
    """Read a PLY file as one part, or none if it has no faces."""
    elements, textures = _read(assets.data)
    vertex, face = (elements.pop(name, _Element(0)) for name in ("vertex", "face"))
    if others := [name for name, element in elements.items() if element.count]:
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
        data, left_out, colors = assets.read(textures[0], is_picture=True), colors, None
        material = Material("unnamed", WHITE, assets.texture(data, textures[0]))
        if left_out is not None:
            assets.say("vertex colors are left out where there is a texture")
    return [MeshPart(points, triangulate(corners, lengths, points), material or assets.gray(), uv, normals, colors)]


def _joined(lists: np.ndarray | tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of lists, one list after the other, and the lists' lengths."""
    if isinstance(lists, np.ndarray):
        return lists.reshape(-1), np.full(len(lists), lists.shape[1])
    return np.concatenate(lists), np.array([*map(len, lists)])


def _read(data: bytes) -> tuple[dict[str, _Element], list[str]]:
    """Return the elements with their values, and the names of textures."""
    if not (head := _HEAD.match(data)):
        raise ValueError("it has no header")
    order, textures, elements, element = "", list[str](), dict[str, _Element](), _Element(0)
    for line in head[0].decode("utf-8", errors="replace").splitlines():
        match line.split():
            case ["format", form, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
            case ["element", name, count]:
                element = elements[name] = _Element(int(count))
            case ["property", *kinds, name]:
                *sizes, kind = (order + _TYPES[kind] for kind in kinds if kind != "list")
                element.properties.append((name, kind, "".join(sizes)))
            case ["comment", key, *_] if key.lower() == "texturefile":
                textures.append(line.partition(key)[2].strip())
    start = head.end()
    if not order:
        data, start = np.array([float(word) for word in data[start:].split()]).tobytes(), 0
    for element in elements.values():
        start = element.read(data, start, not order)
    return elements, list(dict.fromkeys(textures))
