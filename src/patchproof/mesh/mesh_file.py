"""Mesh files: OBJ (with MTL), GLB, glTF, PLY and STL turned into parts, and what had to be assumed on the way.

In: a file and the rotation into the world's axes. Out: parts with the scene graph's transforms applied, and warnings.
Colors: a glTF base color and COLOR_0 are linear light, as its specification says; an OBJ's Kd and the vertex colors
of OBJ and PLY are taken as sRGB, as their exporters write them. Vertex colors multiply the material in glTF; elsewhere
they stand for a missing texture. A texture's alpha is dropped: what it would let shine through is drawn opaque.
Refused: a file that cannot be parsed, and a texture that the file names but that is missing or broken.
Left out on purpose: metal, roughness, emission, normal maps, transparency, skins and animation.

trimesh parses. Its loaders are called below its `Trimesh` class, which would round colors to 8 bits and make up
normals that the file does not have; they keep silent about missing files and invent a 2×2 image; both are looked for.
"""

from __future__ import annotations

import json
import re
import warnings as python_warnings
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import IMAGE_FORMATS as PICTURES
from patchproof.base.input import MAX_IMAGE_PX, is_file
from patchproof.mesh.assets import MOST_BYTES, Assets
from patchproof.mesh.mesh import Material, MeshPart, normal_transform, topology_warnings

FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl")
MOST_FACES = 20_000_000  # a scan of a building has fewer
GRAY_LINEAR = (0.21404114, 0.21404114, 0.21404114)  # sRGB 0.5: what an object without color is taken to be
WHITE = (1.0, 1.0, 1.0)


def read_parts(path: Path, world_from_file: np.ndarray) -> tuple[list[MeshPart], list[str]]:
    """Every placed piece of geometry with faces, vertices and normals turned by `world_from_file` 3×3, and warnings."""
    if not is_file(path):
        raise Refused("a mesh file", f"no file at {path}", "check the path")
    if path.suffix.lower() not in FORMATS:
        raise Refused(f"a mesh file ({', '.join(FORMATS)})", path.name, "export the mesh in one of these formats")
    reader = _Reader(path)
    try:
        reader.load()
        parts = reader.parts(world_from_file)
        if not parts:
            raise Refused("a mesh with faces", f"none in {path.name}", "export the object as triangles")
        return parts, [*dict.fromkeys(reader.warnings), *topology_warnings(parts)]
    except Refused:
        raise
    except Exception as error:  # the parsers raise whatever they stumble over, and so do odd arrays and graphs
        reader.refuse_missing()
        got = f"{path.name} that cannot be read ({f'{type(error).__name__}: {error}'[:120]})"
        raise Refused(f"a mesh as {path.suffix[1:].upper()}", got, "export it again") from error


class _Reader:
    """One file while it is read: what trimesh found in it, materials already made, and the warnings so far."""

    def __init__(self, path: Path):
        self.path, self.assets, self.warnings = path, Assets(path), []
        self.kind = path.suffix.lower()[1:]
        self.is_gltf = self.kind in {"glb", "gltf"}
        self.textures: dict[int, np.ndarray] = {}
        self.materials: dict[tuple, Material] = {}
        self.header: dict[str, Any] = {}
        self.loaded: dict[str, Any] = {}

    def load(self) -> None:
        """Let trimesh parse the file, and refuse what the file names but is not there."""
        from trimesh.exchange.load import mesh_loaders

        if self.is_gltf:
            self.header = _gltf_header(self.path)
        if self.kind == "obj":
            _check_obj(self.path)
        with open(self.path, "rb") as file, python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore")  # about numpy's parsers, not about the mesh
            self.loaded = mesh_loaders[self.kind](file, file_type=self.kind, resolver=self.assets)
        self.refuse_missing()
        used = set(self.header.get("extensionsUsed", ())) | set(self.header.get("extensionsRequired", ()))
        for name in sorted(used & {"KHR_texture_transform", "KHR_draco_mesh_compression", "EXT_meshopt_compression"}):
            self.warnings.append(f"the glTF extension {name} is not read; textures or shapes may be wrong")
        if any(m.get("alphaMode", "OPAQUE") != "OPAQUE" for m in self.header.get("materials", ())):
            self.warnings.append("transparent materials are drawn opaque")

    def parts(self, world_from_file: np.ndarray) -> list[MeshPart]:
        """All that has faces, each as often as it is placed."""
        placed = [(world, raw, recipe) for world, raw, recipe in self.placed() if np.size(raw.get("faces", ()))]
        if sum(len(raw["faces"]) for _, raw, _ in placed) > MOST_FACES:
            got = f"more in {self.path.name}, some of them placed many times"
            raise Refused(f"a mesh of at most {MOST_FACES // 10**6} million faces", got, "export a coarser one")
        return [
            self.part(raw, recipe, world_from_file @ world[:3])
            for world, raw, recipe in placed
            if np.size(raw["vertices"])
        ]

    def placed(self) -> list[tuple[np.ndarray, dict, dict]]:
        """(world_from_part 4×4, trimesh's arrays, the glTF primitive) of each placed geometry."""
        from trimesh.scene.transforms import SceneGraph

        geometry = self.loaded.get("geometry", {"": self.loaded})
        primitives = [p for m in self.header.get("meshes", ()) for p in m["primitives"]]
        # trimesh keeps the primitives' order and leaves out fans and loops (modes 2, 3, 6)
        recipes = dict(zip(geometry, (p for p in primitives if p.get("mode", 4) in (0, 1, 4, 5)), strict=False))
        places = [(np.eye(4), name) for name in geometry]
        if self.is_gltf:
            graph = SceneGraph(base_frame=self.loaded.get("base_frame", "world"))
            for edge in self.loaded.get("graph", ()):
                graph.update(**edge)
            # in the loader's order: the graph's own is that of a set, another one in every process
            nodes = dict.fromkeys(edge["frame_to"] for edge in self.loaded.get("graph", ()) if edge.get("geometry"))
            places = [graph[node] for node in nodes]
        return [(np.asarray(world, float), geometry[name], recipes.get(name, {})) for world, name in places]

    def part(self, raw: dict[str, Any], primitive: dict, transform: np.ndarray) -> MeshPart:
        """The part of a geometry, carried by `transform` 3×4."""
        from trimesh.geometry import triangulate_quads

        faces = triangulate_quads(raw["faces"])
        vertices = np.asarray(raw["vertices"], float)
        rotation = transform[:, :3]
        if np.linalg.det(rotation) < 0:  # a mirror turns triangles inside out
            faces = faces[:, ::-1]
        with np.errstate(invalid="ignore", over="ignore"):
            placed = vertices @ rotation.T + transform[:, 3]
            normals = raw.get("vertex_normals")
            usable = normals is not None and np.shape(normals) == vertices.shape
            normals = np.asarray(normals, float) @ normal_transform(rotation).T if usable else None
        uv = self._uv(raw.get("visual"), len(vertices))
        colors = self._corner_colors(raw, len(vertices), len(faces))
        material = self._material(raw.get("visual"), primitive, uv is not None, colors is not None)
        if colors is not None and not self.is_gltf and material.texture_srgb is not None:
            self.warnings.append("vertex colors are left out where there is a texture")
            colors = None
        if colors is None or len(colors) == len(vertices):
            return MeshPart(placed, faces, material, uv, normals, colors)
        corners = faces.reshape(-1)  # one color per face: give every face corners of its own
        uv, normals = (None if array is None else array[corners] for array in (uv, normals))
        own = np.arange(len(corners)).reshape(-1, 3)
        return MeshPart(placed[corners], own, material, uv, normals, np.repeat(colors, 3, axis=0))

    def refuse_missing(self) -> None:
        """Refuse a missing or broken texture; a missing MTL is warned about."""
        for name in dict.fromkeys(self.assets.missing):
            if not name.lower().endswith(".mtl"):
                do = f"put it into {self.path.parent}"
                raise Refused(f"the file {name}, which {self.path.name} names", "none", do)
            self.warnings.append(f"the material file {name} is missing")
        for name in self.assets.broken:
            raise Refused(f"the texture {name} of {self.path.name}", "no picture that can be read", "export it again")

    def _uv(self, visual, count: int) -> np.ndarray | None:
        """Coordinates with v down, or None; trimesh's run up, whatever the file's do."""
        uv = getattr(visual, "uv", None)
        if uv is None or len(uv) != count:
            return None
        finite = np.all(np.isfinite(uv), axis=1)
        if not finite.all():
            self.warnings.append(f"{np.count_nonzero(~finite)} texture coordinates are not numbers and are taken as 0")
        u, v = np.asarray(uv, float)[:, :2].T
        return np.where(finite[:, None], np.column_stack([u, 1 - v]), 0.0)

    def _corner_colors(self, raw: dict, vertex_count: int, face_count: int) -> np.ndarray | None:
        """Linear colors per vertex, or per face, or None."""
        colors = raw.get("vertex_colors")
        if colors is None:
            colors = getattr(raw.get("visual"), "vertex_attributes", {}).get("color")
        if colors is None or len(colors) != vertex_count:
            colors = raw.get("face_colors")
        if colors is None or len(colors) not in (vertex_count, face_count):
            return None
        colors = np.asarray(colors)[:, :3]
        top = np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else 1.0
        colors = np.asarray(colors, float) / top
        broken = ~np.all(np.isfinite(colors), axis=1)
        if broken.any():
            self.warnings.append(f"{np.count_nonzero(broken)} vertex colors are not numbers and are taken as gray 0.5")
        if top == 1.0 and not self.is_gltf and np.max(colors[~broken], initial=0.0) > 1:
            self.warnings.append("vertex colors above 1 are taken as 0 to 255")
            colors = colors / 255
        colors = np.clip(np.where(broken[:, None], 0.0, colors), 0.0, 1.0)
        linear = colors if self.is_gltf else linear_from_srgb(colors)
        return np.where(broken[:, None], GRAY_LINEAR, linear)

    def _material(self, visual, primitive: dict, has_uv: bool, has_colors: bool) -> Material:
        """The material of a geometry, made once for all that share it."""
        source = getattr(visual, "material", None)
        image = getattr(source, "baseColorTexture", None) if self.is_gltf else getattr(source, "image", None)
        if image is not None and image.format is None:  # trimesh's own invention: a read image knows its format
            image = None
        key = (id(source), id(image), has_uv, has_colors)
        if key not in self.materials:
            self.materials[key] = self._make_material(source, image, primitive, has_uv, has_colors)
        return self.materials[key]

    def _make_material(self, source, image, primitive: dict, has_uv: bool, has_colors: bool) -> Material:
        if image is not None and not has_uv:
            self.warnings.append("a texture without texture coordinates is left out")
            image = None
        texture = None if image is None else self._texture(image)
        name = str(getattr(source, "name", None) or "unnamed")
        if self.is_gltf and source is not None:
            return Material(name, self._gltf_base_color(source, primitive, texture is not None), texture)
        if has_colors and texture is None:
            return Material("vertex colors", WHITE)
        kd = (getattr(source, "kwargs", None) or {}).get("kd")
        if kd is None or np.shape(kd) != (3,) or not np.isfinite(kd).all():
            if texture is None:
                self.warnings.append("faces without a material color are taken as gray 0.5")
            return Material(name, GRAY_LINEAR if texture is None else WHITE, texture)
        if texture is not None and not np.any(kd):  # exporters write Kd 0 0 0 beside a map and mean "the map alone"
            kd = WHITE
        red, green, blue = linear_from_srgb(np.clip(np.asarray(kd, float), 0, 1)).tolist()
        return Material(name, (red, green, blue), texture)

    def _gltf_base_color(self, source, primitive: dict, has_texture: bool) -> tuple[float, float, float]:
        """The factor as the file has it; trimesh's is rounded to 8 bits, and serves for old extensions only."""
        material = self.header["materials"][primitive["material"]] if "material" in primitive else {}
        metal_rough = material.get("pbrMetallicRoughness", {})
        named = metal_rough.get("baseColorTexture")
        if named is not None and not has_texture and getattr(source, "baseColorTexture", None) is None:
            expected = f"the texture of {source.name!s} in {self.path.name} as PNG, JPEG or WebP"
            raise Refused(expected, "none or a broken one", "export it again")
        if named is not None and named.get("texCoord", 0) != 0:
            self.warnings.append("a texture asks for its second set of coordinates; the first is used")
        factor = metal_rough.get("baseColorFactor")
        if factor is None:
            factor = WHITE if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255
        red, green, blue = map(float, factor[:3])
        return red, green, blue

    def _texture(self, image) -> np.ndarray:
        """An image as uint8 H×W×3; 16 bits are cut to 8, alpha is dropped."""
        if id(image) not in self.textures:
            try:
                if image.format not in PICTURES or image.width * image.height > MAX_IMAGE_PX:
                    raise ValueError(f"{image.format} of {image.width} × {image.height} pixels")
                if image.mode.startswith("I"):  # Pillow would clip 16 bits at 255 instead of scaling them
                    pixels = np.repeat((np.asarray(image) >> 8).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
                else:
                    pixels = np.asarray(image.convert("RGB"))
            except Exception as error:
                got = f"a broken one ({str(error)[:80]})"
                raise Refused(f"a texture of {self.path.name} that can be read", got, "export it again") from error
            self.textures[id(image)] = pixels
        return self.textures[id(image)]


def _gltf_header(path: Path) -> dict:
    """The JSON of a GLB or glTF file. trimesh reads another file, model.gltf, where a .gltf is no JSON."""
    text = path.read_bytes()
    if path.suffix.lower() == ".glb":
        if text[:4] != b"glTF":
            raise ValueError("it does not start with glTF")
        text = text[20 : 20 + int.from_bytes(text[12:16], "little")]
    header = json.loads(text)
    if not isinstance(header, dict):
        raise ValueError("its JSON is no object")
    # trimesh takes memory for both before it looks into the file
    copied = sum(abs(view["byteLength"]) for view in header.get("bufferViews", ()))
    made_up = sum(abs(accessor["count"]) for accessor in header.get("accessors", ()) if "bufferView" not in accessor)
    if copied > MOST_BYTES or made_up > MOST_FACES:
        raise ValueError(f"it asks for {copied} bytes and {made_up} zeros")
    return header


def _check_obj(path: Path):
    """Two things that trimesh reads wrongly without a word: short faces, and indices relative to where they stand."""
    text = path.read_bytes().replace(b"\\\n", b" ")
    short = re.search(rb"^f(?:[ \t]+\S+){0,2}[ \t]*\r?$", text, re.MULTILINE)
    if short:
        line = text.count(b"\n", 0, short.start()) + 1
        got = f"{len(short[0].split()) - 1} in line {line} of {path.name}"
        raise Refused("faces with at least three corners", got, "the file may be cut short, export it again")
    relative = re.search(rb"^f[^\n]*[ \t/]-\d", text, re.MULTILINE)
    if relative and re.search(rb"^v[tn]?[ \t]", text[relative.end() :], re.MULTILINE):
        got = f"some in {path.name} that stand before further vertices"
        raise Refused("relative indices after the last vertex", got, "export with absolute indices")
