"""Read mesh files: OBJ (with MTL), GLB, glTF, PLY and STL as parts, with warnings about assumptions.

In: a file and the rotation into the world's axes. Out: parts with the scene graph's transforms applied, and warnings.
Colors: a glTF base color and COLOR_0 are linear light, as its specification says; an OBJ's Kd and the vertex colors of
OBJ and PLY are taken as sRGB, as their exporters write them. Vertex colors multiply the material in glTF; elsewhere
they stand for a missing texture. A texture's alpha is dropped: transparent texels are drawn opaque. Refused: a file
that cannot be parsed, and a texture that the file names but that is missing or broken. Left out on purpose: metal,
roughness, emission, normal maps, transparency, skins and animation.

trimesh parses. Its loaders are called below its `Trimesh` class, which would round colors to 8 bits and invent normals
that the file does not have. The loaders do not report missing files and invent a 2×2 image for them; both are checked
here.
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
from patchproof.base.input import IMAGE_FORMATS, MAX_IMAGE_PX, is_file
from patchproof.mesh.assets import MOST_BYTES, Assets
from patchproof.mesh.mesh import Material, MeshPart, normal_transform, topology_warnings

FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl")
MOST_FACES = 20_000_000  # a scan of a building has fewer
GRAY_LINEAR = (0.21404114, 0.21404114, 0.21404114)  # sRGB 0.5, for an object without color
WHITE = (1.0, 1.0, 1.0)


def read_parts(path: Path, world_from_file: np.ndarray) -> tuple[list[MeshPart], list[str], list[Path]]:
    """Read every placed geometry with faces, its vertices and normals turned by `world_from_file` 3×3; warnings; and
    the files that were read.
    """
    if not is_file(path) or not path.stat().st_size:  # some files of the system are empty, and never end
        raise Refused("a mesh file", f"no file at {path}, or an empty one", "check the path")
    if path.suffix.lower() not in FORMATS:
        raise Refused(f"a mesh file ({', '.join(FORMATS)})", path.name, "export the mesh in one of these formats")
    reader = _MeshFileReader(path)
    try:
        reader.load()
        parts = reader.parts(world_from_file)
        if not parts:
            raise Refused("a mesh with faces", f"no face in {path.name}", "export the object as triangles")
        return parts, [*dict.fromkeys(reader.warnings), *topology_warnings(parts)], reader.assets.files
    except Refused:
        raise
    except Exception as error:  # parsers, arrays of odd shapes and broken graphs raise many types of error
        reader.refuse_missing()
        got = f"{path.name} that cannot be read ({f'{type(error).__name__}: {error}'[:120]})"
        raise Refused(f"a mesh as {path.suffix[1:].upper()}", got, "export it again") from error


class _MeshFileReader:
    """The state of reading one file: trimesh's result, the materials made so far, and the warnings."""

    def __init__(self, path: Path):
        self.path, self.assets, self.warnings = path, Assets(path), []
        self.kind = path.suffix.lower()[1:]
        self.is_gltf = self.kind in {"glb", "gltf"}
        self.textures: dict[int, np.ndarray] = {}
        self.materials: dict[tuple, Material] = {}
        self.header: dict[str, Any] = {}
        self.loaded: dict[str, Any] = {}

    def load(self) -> None:
        """Let trimesh parse the file, and refuse it if files that it names are missing."""
        from trimesh.exchange.load import mesh_loaders

        if self.is_gltf:
            self.header = _gltf_header(self.path)
        if self.kind == "obj":
            _check_obj(self.path)
        with open(self.path, "rb") as file, python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore")  # about numpy's parsers, not about the mesh
            self.loaded = mesh_loaders[self.kind](file, file_type=self.kind, resolver=self.assets)
        self.refuse_missing()
        names = set(self.header.get("extensionsUsed", ())) | set(self.header.get("extensionsRequired", ()))
        for name in sorted(names & {"KHR_texture_transform", "KHR_draco_mesh_compression", "EXT_meshopt_compression"}):
            self.warnings.append(f"the glTF extension {name} is not read; textures or shapes may be wrong")
        if any(m.get("alphaMode", "OPAQUE") != "OPAQUE" for m in self.header.get("materials", ())):
            self.warnings.append("transparent materials are drawn opaque")

    def parts(self, world_from_file: np.ndarray) -> list[MeshPart]:
        """Return each geometry that has faces, once for every time it is placed."""
        placements = [placement for placement in self.placements() if np.size(placement[1].get("faces", ()))]
        faces = sum(len(raw["faces"]) for _, raw, _ in placements)
        if faces > MOST_FACES:
            got = f"{faces} faces in {self.path.name}, counted as often as they are placed"
            raise Refused(f"a mesh of at most {MOST_FACES // 10**6} million faces", got, "export a coarser one")
        placements = [placement for placement in placements if np.size(placement[1]["vertices"])]
        return [self.part(raw, primitive, world_from_file @ world[:3]) for world, raw, primitive in placements]

    def placements(self) -> list[tuple[np.ndarray, dict, dict]]:
        """Return (world_from_part 4×4, trimesh's arrays, the glTF primitive) of each placed geometry."""
        from trimesh.scene.transforms import SceneGraph

        geometry = self.loaded.get("geometry", {"": self.loaded})
        primitives = [p for m in self.header.get("meshes", ()) for p in m["primitives"]]
        # trimesh keeps the primitives' order and leaves out fans and loops (modes 2, 3, 6)
        primitive_of = dict(zip(geometry, (p for p in primitives if p.get("mode", 4) in (0, 1, 4, 5)), strict=False))
        placements = [(np.eye(4), name) for name in geometry]
        if self.is_gltf:
            graph = SceneGraph(base_frame=self.loaded.get("base_frame", "world"))
            for edge in self.loaded.get("graph", ()):
                graph.update(**edge)
            # in the loader's order: the graph's own order is that of a set and differs between processes
            nodes = dict.fromkeys(edge["frame_to"] for edge in self.loaded.get("graph", ()) if edge.get("geometry"))
            placements = [graph[node] for node in nodes]
        return [(np.asarray(world, float), geometry[name], primitive_of.get(name, {})) for world, name in placements]

    def part(self, raw: dict[str, Any], primitive: dict, transform: np.ndarray) -> MeshPart:
        """Return the part of a geometry, transformed by `transform` 3×4."""
        from trimesh.geometry import triangulate_quads

        faces = triangulate_quads(raw["faces"])
        vertices = np.asarray(raw["vertices"], float)
        rotation = transform[:, :3]
        if np.linalg.det(rotation) < 0:  # a mirror turns triangles inside out
            faces = faces[:, ::-1]
        with np.errstate(invalid="ignore", over="ignore"):
            world_vertices = vertices @ rotation.T + transform[:, 3]
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
            return MeshPart(world_vertices, faces, material, uv, normals, colors)
        corners = faces.reshape(-1)  # one color per face: give every face corners of its own
        uv, normals = (None if array is None else array[corners] for array in (uv, normals))
        corner_faces = np.arange(len(corners)).reshape(-1, 3)
        return MeshPart(world_vertices[corners], corner_faces, material, uv, normals, np.repeat(colors, 3, axis=0))

    def refuse_missing(self) -> None:
        """Refuse a missing or broken texture; warn about a missing MTL."""
        for name in dict.fromkeys(self.assets.missing):
            if not name.lower().endswith(".mtl"):
                remedy = f"put it into {self.path.parent}"
                raise Refused(f"the file {name}, which {self.path.name} names", "no such file", remedy)
            self.warnings.append(f"the material file {name} is missing")
        for name in self.assets.broken:
            raise Refused(f"the texture {name} of {self.path.name}", "a file that is no image", "export it again")

    def _uv(self, visual, count: int) -> np.ndarray | None:
        """Return coordinates with v down, or None; trimesh's v runs up in every format."""
        uv = getattr(visual, "uv", None)
        if uv is None or len(uv) != count:
            return None
        finite = np.all(np.isfinite(uv), axis=1)
        if not finite.all():
            self.warnings.append(f"{np.count_nonzero(~finite)} texture coordinates are not numbers and are taken as 0")
        u, v = np.asarray(uv, float)[:, :2].T
        return np.where(finite[:, None], np.column_stack([u, 1 - v]), 0.0)

    def _corner_colors(self, raw: dict, vertex_count: int, face_count: int) -> np.ndarray | None:
        """Return linear colors per vertex, or per face, or None."""
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
        """Return the material of a geometry, made once for all that share it."""
        source = getattr(visual, "material", None)
        image = getattr(source, "baseColorTexture", None) if self.is_gltf else getattr(source, "image", None)
        if image is not None and image.format is None:  # invented by trimesh: an image from a file knows its format
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
        """Return the factor that the file has; trimesh's is rounded to 8 bits and serves for old extensions only."""
        material = self.header["materials"][primitive["material"]] if "material" in primitive else {}
        metal_rough = material.get("pbrMetallicRoughness", {})
        texture_entry = metal_rough.get("baseColorTexture")
        if texture_entry is not None and not has_texture and getattr(source, "baseColorTexture", None) is None:
            expected = f"the texture of {source.name!s} in {self.path.name} as PNG, JPEG or WebP"
            raise Refused(expected, "a missing or broken image", "export it again")
        if texture_entry is not None and texture_entry.get("texCoord", 0) != 0:
            self.warnings.append("a texture asks for its second set of coordinates; the first is used")
        factor = metal_rough.get("baseColorFactor")
        if factor is None:
            factor = WHITE if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255
        red, green, blue = map(float, factor[:3])
        return red, green, blue

    def _texture(self, image) -> np.ndarray:
        """Return an image as uint8 H×W×3; 16 bits are cut to 8, alpha is dropped."""
        if id(image) not in self.textures:
            try:
                if image.format not in IMAGE_FORMATS or image.width * image.height > MAX_IMAGE_PX:
                    raise ValueError(f"{image.format} of {image.width} × {image.height} pixels")
                if image.mode.startswith("I"):  # Pillow would clip 16 bits at 255 instead of scaling them
                    pixels = np.repeat((np.asarray(image) >> 8).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
                else:
                    pixels = np.asarray(image.convert("RGB"))
            except Exception as error:
                got = f"a broken image ({str(error)[:80]})"
                raise Refused(f"a texture of {self.path.name} that can be read", got, "export it again") from error
            self.textures[id(image)] = pixels
        return self.textures[id(image)]


def _gltf_header(path: Path) -> dict:
    """Return the JSON of a GLB or glTF file. If a .gltf is no JSON, trimesh reads another file, model.gltf, instead."""
    text = path.read_bytes()
    if path.suffix.lower() == ".glb":
        if text[:4] != b"glTF":
            raise ValueError("it does not start with glTF")
        text = text[20 : 20 + int.from_bytes(text[12:16], "little")]
    header = json.loads(text)
    if not isinstance(header, dict):
        raise ValueError("its JSON is no object")
    # trimesh allocates memory for both before it reads the file's contents
    data_bytes = sum(abs(view["byteLength"]) for view in header.get("bufferViews", ()))
    zeros = sum(abs(accessor["count"]) for accessor in header.get("accessors", ()) if "bufferView" not in accessor)
    if data_bytes > MOST_BYTES or zeros > MOST_FACES:
        raise ValueError(f"it asks for {data_bytes} bytes and {zeros} zeros in memory")
    return header


def _check_obj(path: Path):
    """Refuse two things that trimesh misreads without a warning: faces with fewer than three corners, and indices
    relative to a vertex list that goes on after them.
    """
    text = path.read_bytes().replace(b"\\\n", b" ")
    short = re.search(rb"^f(?:[ \t]+\S+){0,2}[ \t]*\r?$", text, re.MULTILINE)
    if short:
        line = text.count(b"\n", 0, short.start()) + 1
        got = f"a face with {len(short[0].split()) - 1} in line {line} of {path.name}"
        raise Refused("faces with at least three corners", got, "the file may be cut short, export it again")
    relative = re.search(rb"^f[^\n]*[ \t/]-\d", text, re.MULTILINE)
    if relative and re.search(rb"^v[tn]?[ \t]", text[relative.end() :], re.MULTILINE):
        got = f"relative indices in {path.name} that stand before further vertices"
        raise Refused("relative indices after the last vertex", got, "export with absolute indices")
