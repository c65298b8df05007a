"""Read OBJ files, as parts in the file's axes.

In: a file and what it names. Out: a part for each material, in the order of first use; faces without texture
coordinates are a part of their own. Vertex colors, taken as sRGB, stand for a missing texture. Left out on purpose:
curves, surfaces, smoothing groups, and what `mtl` leaves out.
"""

from array import array
from collections import Counter, defaultdict

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.validation import summarize_names
from patchproof.mesh.assets import Assets
from patchproof.mesh.mesh import MeshPart
from patchproof.mesh.mtl import MaterialLibrary, logical_lines
from patchproof.mesh.polygons import triangulate
from patchproof.mesh.texture_wrap import draw_out_textures

_WIDTHS = {"v": 7, "vt": 2, "vn": 3}  # numbers that are kept of a row: v has x, y, z, and w or a color
_WITHOUT_EFFECT = ("o", "g", "mg", "s")


class _Faces:
    """Faces of one material: each different corner v/vt/vn by its number, and the polygons' corners, joined."""

    def __init__(self):
        self.numbers, self.corners, self.lengths = dict[str, int](), array("q"), array("q")


def read_obj(assets: Assets) -> list[MeshPart]:
    """Read the parts of an OBJ file."""
    library, left_out, widths = MaterialLibrary(assets), Counter[str](), set[int]()
    rows = {key: array("d") for key in _WIDTHS}
    groups = defaultdict[tuple[str, bool], _Faces](_Faces)  # by material, and if corners have texture coordinates
    material, is_smooth = "", False
    for number, line in enumerate(logical_lines(assets.data), 1):
        key, rest = [*line.split(None, 1), "", ""][:2]
        words = (rest.partition("#")[0] if "#" in rest else rest).split()
        if key in rows:
            rows[key].extend([*map(float, words), *[0.0] * _WIDTHS[key]][: _WIDTHS[key]])
            widths |= {len(words)} if key == "v" else set()
        elif key == "f":
            if len(words) < 3:
                got = f"a face with {len(words)} in line {number} of {assets.path.name}"
                raise Refused("faces with at least three corners", got, "the file may be cut short, export it again")
            if "-" in rest:
                words = [_absolute(word, rows) for word in words]
            faces = groups[material, "/" in words[0] and "//" not in rest]
            faces.corners.extend([faces.numbers.setdefault(word, len(faces.numbers)) for word in words])
            faces.lengths.append(len(words))
        elif key == "usemtl":
            material = rest.strip()
        elif key == "mtllib":
            library.read(rest.strip())
        elif key and key[0] != "#" and key not in _WITHOUT_EFFECT:
            left_out[key[:20]] += 1
        is_smooth |= key == "s" and words not in (["off"], ["0"])
    if left_out:
        counts = summarize_names([f"{count} × {key}" for key, count in left_out.items()])
        assets.say(f"left out of {assets.path.name}: {counts}")
    if is_smooth and not rows["vn"]:
        assets.say("smoothing groups are left out: faces without normals are drawn flat")
    if widths - {3, 6, 7} or len(widths) > 1:
        assets.say("weights of vertices, and colors of only some vertices, are left out")
    library.check_names([name for name, _ in groups])
    # row 0 is for corners without a number
    tables = [np.insert(np.reshape(rows[key], (-1, width)), 0, np.nan, axis=0) for key, width in _WIDTHS.items()]
    if widths in ({6}, {7}):
        tables.append(np.insert(assets.linear_colors(tables[0][1:, 3:6], is_srgb=True), 0, np.nan, axis=0))
    parts = [_part(key, faces, tables, library) for key, faces in groups.items()]
    return draw_out_textures(parts, library.wraps, assets)


def _absolute(corner: str, rows: dict[str, array]) -> str:
    """Return a corner v/vt/vn whose relative numbers count from the start of the lists."""
    numbers = zip(corner.split("/"), rows.items(), strict=False)
    return "/".join(str(len(row) // _WIDTHS[k] + 1 + int(n)) if "-" in n else n for n, (k, row) in numbers)


def _part(key: tuple[str, bool], faces: _Faces, tables: list[np.ndarray], library: MaterialLibrary) -> MeshPart:
    """Return the part of some faces with one material; `tables` are those of v, vt and vn, and of colors if any."""
    corners = np.array([[int(number or 0) for number in f"{corner}//".split("/")[:3]] for corner in faces.numbers])
    for table, column, kind in zip(tables, corners.T, _WIDTHS, strict=False):
        low, high = column.min(), column.max()
        if low < (kind == "v") or high >= len(table):
            got = f"{high if high >= len(table) else low} in {library.assets.path.name}"
            raise Refused(f"faces that name {kind} 1 to {len(table) - 1}", got, "export the mesh again")
    vertices, uv, normals, *colors = (table[corners[:, i % 3]] for i, table in enumerate(tables))
    triangles = triangulate(np.array(faces.corners), np.array(faces.lengths), vertices[:, :3])
    material, scale, shift = library.material(*key, bool(colors))
    if colors and material.texture_srgb is not None:
        library.assets.say("vertex colors are left out where there is a texture")
        colors = []
    uv = library.assets.finite_uv(uv * scale + shift) * (1, -1) + (0, 1) if key[1] else None
    return MeshPart(vertices[:, :3], triangles, material, uv, normals if corners[:, 2].any() else None, *colors)
