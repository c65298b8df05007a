"""Read OBJ files, as parts in the file's axes.

In: a file and what it names. Out: a part for each material, in the order of first use; faces without texture
coordinates are a part of their own. Vertex colors, taken as sRGB, stand for a missing texture. Of the materials in MTL
files, Kd is taken as sRGB, as exporters write it, and multiplies map_Kd, of whose options -s, -o, -clamp and -mm are
used and others are said. Left out on purpose: curves, surfaces, smoothing groups, other maps, emission, transparency.
"""

from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections import Counter, defaultdict
from itertools import takewhile
from pathlib import Path

import numpy as np

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.validation import summarize_names
from patchproof.mesh.assets import VERTEX_COLORS, WHITE, Assets, Wrap, draw_out_textures
from patchproof.mesh.mesh import Material, MeshPart, triangulate

_MAPS = ("map_", "bump", "norm", "disp", "decal", "refl")
_MOST_NUMBERS = {"-mm": 2, "-s": 3, "-o": 3, "-t": 3}  # after an option; others have one word
_OPTIONS_WITHOUT_EFFECT = ("-blendu on", "-blendv on", "-cc off", "-boost 0", "-t 0", "-t 0 0", "-t 0 0 0")
_WIDTHS = {"v": 7, "vt": 2, "vn": 3}  # numbers that are kept of a row: v has x, y, z, and w or a color
_WITHOUT_EFFECT = ("o", "g", "mg", "s")
_Faces = tuple[dict[str, int], "array[int]", "array[int]"]


def logical_lines(data: bytes) -> list[str]:
    """Return the lines of a text; a backslash at a line's end continues it."""
    try:
        text = data.decode("utf-16" if data[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig")
    except UnicodeDecodeError:  # of another encoding, in which names must stay apart
        text = data.decode("latin-1")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text.replace("\\\n", " ").split("\n")


class MaterialLibrary:
    """The materials that an OBJ file's MTL files define, and how textures continue that do not repeat."""

    def __init__(self, assets: Assets):
        self.assets, self.wraps = assets, dict[Material, tuple[Wrap, Wrap]]()
        self.entries: dict[str, tuple[Path | None, dict[str, str]]] = {}
        self._made: dict[tuple[str, bool], tuple[Material, np.ndarray, np.ndarray]] = {}

    def read(self, names: str) -> None:
        """Read the files of a line: one name, which may hold spaces, or several."""
        for name in [names] if self.assets.find(names) else names.split():
            path, values = self.assets.find(name), {}
            if path is None:
                self.assets.say(f"the material file {name} is missing in the folder of {self.assets.path.name}")
            for line in logical_lines(self.assets.read(name)) if path else ():
                key, value = [*line.split(None, 1), "", ""][:2]
                if key == "newmtl":
                    values = self.entries.setdefault(value.strip(), (path and path.parent, {}))[1]
                else:
                    values[key.lower()] = value.strip()

    def material(self, name: str, has_uv: bool, has_colors: bool) -> tuple[Material, np.ndarray, np.ndarray]:
        """Return a material, made once, and the scale and shift of its texture coordinates."""
        if (name, has_uv) not in self._made:
            folder, values = self.entries.get(name, (None, {}))
            texture, (options, file_name) = None, _options(values.get("map_kd", ""))
            if file_name and has_uv:
                base, gain = _numbers(options.get("-mm", "0 1"))
                texture = self.assets.texture(self.assets.read(file_name, folder, True), file_name, base, gain)
            elif file_name:
                self.assets.say("a texture without texture coordinates is left out")
            self._say_left_out(values, options)
            material = VERTEX_COLORS
            if texture is not None or not has_colors:
                material = Material(name or "unnamed", self._kd(name, values, texture is not None), texture)
            self.wraps |= {material: ("clamp", "clamp")} if options.get("-clamp", "").casefold() == "on" else {}
            scale, shift = _numbers(options.get("-s", "")), _numbers(options.get("-o", ""))
            self._made[name, has_uv] = material, np.array([*scale, 1, 1])[:2], np.array([*shift, 0, 0])[:2]
        return self._made[name, has_uv]

    def _kd(self, name: str, values: dict[str, str], has_texture: bool) -> tuple[float, float, float]:
        """Return Kd as linear light; one number counts for all three, and black beside a texture as white."""
        kd = _numbers(text := values.get("kd", ""))
        if max(kd, default=0) > 1:
            self.assets.say(f"Kd {text[:40]} of {name} is cut at 1")
        if len(kd) < len(text.split()):  # "spectral" and "xyz" are allowed, too
            self.assets.say(f"Kd {text[:40]} of {name} is not read")
        if len(kd) not in (1, 3) or len(kd) < len(text.split()) or (has_texture and not any(kd)):
            return WHITE if has_texture else self.assets.gray().base_color_linear
        red, green, blue = np.broadcast_to(linear_from_srgb(np.clip(kd, 0, 1)), 3).tolist()
        return red, green, blue

    def _say_left_out(self, values: dict[str, str], options: dict[str, str]) -> None:
        others = [key for key, value in options.items() if f"{key} {value}" not in _OPTIONS_WITHOUT_EFFECT]
        left_out = [f"map_Kd {key}" for key in others if key not in ("-s", "-o", "-mm", "-clamp")]
        left_out += [key for key in values if key.startswith(_MAPS) and key not in ("map_kd", "map_d")]
        left_out += ["Ke"] if any(_numbers(values.get("ke", ""))) else []
        if left_out:
            self.assets.say(f"left out of materials: {', '.join(left_out)}")
        opacity = [*_numbers(values.get("d", "")), *(1 - tr for tr in _numbers(values.get("tr", "")))]
        if "map_d" in values or min(opacity[:1], default=1) < 1:  # some exporters write d 1 and Tr 1 for opaque
            self.assets.say("transparent materials are drawn opaque")


def _numbers(text: str) -> list[float]:
    """Return the numbers in a value, without words such as -halo, spectral or xyz."""
    return [float(word) for word in text.split() if _is_number(word)]


def _options(text: str) -> tuple[dict[str, str], str]:
    """Return the options of a map and the name of its file, which may hold spaces."""
    words, options = text.split(), {}
    while len(words) > 1 and words[0].startswith("-"):
        key, most = words[0], _MOST_NUMBERS.get(words[0], 1)
        count = len([*takewhile(_is_number, words[1 : 1 + most])]) if most > 1 else 1
        options[key], words = " ".join(words[1 : 1 + count]), words[1 + count :]
    return options, " ".join(words)


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def read_obj(assets: Assets) -> list[MeshPart]:
    """Read the parts of an OBJ file."""
    library, left_out, widths = MaterialLibrary(assets), Counter[str](), set[int]()
    rows = {key: array("d") for key in _WIDTHS}
    # by material, and if corners have texture coordinates: the numbers of different corners v/vt/vn, the polygons'
    # corners, joined, and how many each has
    groups = defaultdict[tuple[str, bool], _Faces](lambda: ({}, array("q"), array("q")))
    material, is_smooth = "", False
    for number, line in enumerate(logical_lines(assets.data), 1):
        key, rest = [*line.split(None, 1), "", ""][:2]
        words = (plain := rest.partition("#")[0]).split()
        if key in rows:
            rows[key].extend([*map(float, words), *[0.0] * _WIDTHS[key]][: _WIDTHS[key]])
            widths |= {len(words)} if key == "v" else set()
        elif key == "f":
            if len(words) < 3:
                got = f"a face with {len(words)} in line {number} of {assets.path.name}"
                raise Refused("faces with at least three corners", got, "the file may be cut short, export it again")
            if "-" in rest:
                words = [_absolute(word, rows) for word in words]
            numbers, corners, lengths = groups[material, "/" in words[0] and "//" not in plain]
            corners.extend([numbers.setdefault(word, len(numbers)) for word in words])
            lengths.append(len(words))
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
    names = dict.fromkeys(name for name, _ in groups)
    if undefined := [name for name in names if name and name not in library.entries]:
        assets.say(f"no MTL file defines {summarize_names(undefined)}")
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
    numbers, polygons, lengths = faces
    corners = np.array([[int(number or 0) for number in f"{corner}//".split("/")[:3]] for corner in numbers])
    for table, column, kind in zip(tables, corners.T, _WIDTHS, strict=False):
        low, high = column.min(), column.max()
        if low < (kind == "v") or high >= len(table):
            got = f"{high if high >= len(table) else low} in {library.assets.path.name}"
            raise Refused(f"faces that name {kind} 1 to {len(table) - 1}", got, "export the mesh again")
    vertices, uv, normals, *colors = (table[corners[:, i % 3]] for i, table in enumerate(tables))
    triangles = triangulate(np.array(polygons), np.array(lengths), vertices[:, :3])
    material, scale, shift = library.material(*key, bool(colors))
    if colors and material.texture_srgb is not None:
        library.assets.say("vertex colors are left out where there is a texture")
        colors = []
    uv = library.assets.finite_uv(uv * scale + shift) * (1, -1) + (0, 1) if key[1] else None
    return MeshPart(vertices[:, :3], triangles, material, uv, normals if corners[:, 2].any() else None, *colors)
