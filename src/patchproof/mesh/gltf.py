"""Read glTF 2.0 (.gltf, .glb): every mesh that the scene shows, as parts in the file's axes.

In: a file and what it names. Out: a part for each primitive and place, with the morph targets' weights in the file.
Base colors and COLOR_0 are linear light and multiply, as the specification says. Refused: required extensions that are
not read, and data shorter than declared. Left out on purpose: metal, roughness, emission, normal maps, transparency,
skins and animation; `declarations.csv` lists what is said of each.
"""

import json
from typing import Any, NoReturn

import numpy as np

from patchproof.base.declarations import load_declarations
from patchproof.base.errors import Refused
from patchproof.base.input import MAX_FILE_BYTES
from patchproof.base.validation import summarize_names
from patchproof.mesh.assets import VERTEX_COLORS, WHITE, Assets, Wrap, draw_out_textures
from patchproof.mesh.mesh import MOST_FACES, Material, MeshPart, transform_part

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror"}
_LEAST_FACES, _VERTICES_PER_FACE = 200, 100  # of what a placed part counts as
_EXTENSIONS = {entry.declares: entry for entry in load_declarations("mesh") if entry.file == "glTF extension"}
_LEFT_OUT = ("metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")
_IMAGE_EXTENSIONS = ("EXT_texture_webp", "EXT_texture_avif")

Entry = dict[str, Any]


def read_gltf(assets: Assets) -> list[MeshPart]:
    """Read the parts that the scene shows, as often as it shows them."""
    file = _GltfReader(assets)
    return draw_out_textures(file.parts(), file.wraps, assets)


class _GltfReader:
    """The state of reading one file: its JSON and binary chunk, and the materials made so far."""

    def __init__(self, assets: Assets):
        self.assets = assets
        self.tree, self.binary = _open(assets)
        self.materials: dict[tuple[int, bool], Material] = {}
        self.wraps: dict[Material, tuple[Wrap, Wrap]] = {}

    def parts(self) -> list[MeshPart]:
        """Return each primitive with triangles, once for every place."""
        placed, faces = [], 0  # counted first, so that neither a million places nor a shared list takes minutes
        for node, world in self.shown_nodes():
            if "skin" in node:
                self.assets.say("skins are left out: meshes are drawn as they were modeled, without a pose")
            mesh = self.item("meshes", node["mesh"])
            attributes = _extension(node, "EXT_mesh_gpu_instancing").get("attributes", {})
            instances = {name.lower(): self.array(accessor) for name, accessor in attributes.items()}
            count = min(map(len, instances.values()), default=1)
            for primitive in mesh["primitives"]:
                vertices = len(self.array(primitive["attributes"]["POSITION"]))
                triangles = self.triangles(primitive, vertices)
                faces += vertices * (1 + len(primitive.get("targets", ()))) // _VERTICES_PER_FACE
                faces += max(len(triangles), _LEAST_FACES) * count
                if faces > (most := min(MOST_FACES, MOST_FACES // 10 + self.assets.size)):
                    got = f"{faces} in {self.assets.path.name}, counted as often as they are placed"
                    raise Refused(f"a mesh of at most {most / 1e6:.3g} million faces", got, "export a coarser one")
                if len(triangles):
                    weights = node.get("weights", mesh.get("weights", ()))
                    placed.append((primitive, triangles, weights, world, instances, count))
        parts = []
        for primitive, triangles, weights, world, instances, count in placed:
            part = self.part(primitive, triangles, weights)
            local = (_local({name: rows[i] for name, rows in instances.items()}) for i in range(count))
            parts += [transform_part(part, (world @ place)[:3]) for place in local]
        return parts

    def shown_nodes(self) -> list[tuple[Entry, np.ndarray]]:
        """Return the nodes with a mesh that the file's scene shows, and their 4×4 in its axes."""
        nodes, scenes, chosen = self.tree.get("nodes", []), self.tree.get("scenes", []), self.tree.get("scene", 0)
        if len(scenes) > 1:
            self.assets.say(f"of {len(scenes)} scenes only scene {chosen} is shown")
        children = {child for node in nodes for child in node.get("children", ())}
        roots = self.item("scenes", chosen).get("nodes", ()) if scenes else sorted({*range(len(nodes))} - children)
        stack, shown, seen = [(i, np.eye(4)) for i in roots], [], set()
        while stack:
            index, world = stack.pop()
            node = self.item("nodes", index)
            if index in seen:
                raise ValueError(f"node {index} is placed twice")
            seen.add(index)
            if _extension(node, "KHR_node_visibility").get("visible", True):
                world = world @ _local(node)
                shown += [(node, world)] if "mesh" in node else []
                stack += [(child, world) for child in node.get("children", ())]
        if hidden := sum("mesh" in node for node in nodes) - len(shown):
            self.assets.say(f"{hidden} nodes with meshes are hidden or outside of the scene, and are left out")
        return shown

    def triangles(self, primitive: Entry, vertices: int) -> np.ndarray:
        """Return the faces F×3 of triangles (mode 4), a strip (5) or a fan (6)."""
        if (mode := primitive.get("mode", 4)) < 4:
            self.assets.say("points and lines are left out")
            return np.zeros((0, 3), int)
        is_list = "indices" in primitive
        corners = self.array(primitive["indices"])[:, 0] if is_list else np.arange(vertices, dtype=np.uint32)
        if np.any(corners == np.iinfo(corners.dtype).max):
            raise ValueError(f"the index {corners.max()}, which glTF reserves")
        corners, i = corners.astype(np.int64), np.arange(len(corners) - 2)
        if mode == 4:
            return corners.reshape(-1, 3)
        faces = corners[np.stack([i, i + 1 + i % 2, i + 2 - i % 2] if mode == 5 else [i + 1, i + 2, 0 * i], axis=1)]
        return faces[(faces != np.roll(faces, 1, axis=1)).all(1)]  # strips repeat corners to turn

    def part(self, primitive: Entry, faces: np.ndarray, weights) -> MeshPart:
        """Return a primitive's part in its mesh's axes, with `weights` of its morph targets."""
        attributes, used = primitive["attributes"], slice(None)
        positions = self.item("accessors", attributes["POSITION"])
        if "bufferView" not in positions and "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
            _refuse_extension("KHR_draco_mesh_compression", self.assets)
        if positions["count"] > faces.size:
            used, faces = np.unique(faces, return_inverse=True)
        material, uv_name, moved = VERTEX_COLORS, "TEXCOORD_0", {}
        if "material" in primitive:
            material, uv_name, moved = self.material(primitive["material"], attributes)
        elif "COLOR_0" not in attributes:
            material = self.assets.gray()
        names = {"POSITION", "NORMAL", "COLOR_0", uv_name} & attributes.keys()
        arrays = {name: self.array(attributes[name], name == "COLOR_0")[used].astype(float) for name in names}
        if len({len(values) for values in arrays.values()}) > 1:
            raise ValueError("attributes of different lengths")
        for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
            for name in target.keys() & names if weight else ():
                arrays[name] += weight * self.array(target[name])[used]
        uv, colors = arrays.get(uv_name), arrays.get("COLOR_0")
        if uv is not None:
            uv = self.assets.finite_uv(_transform_uv(uv, **moved))
        if colors is not None:
            colors = self.assets.linear_colors(colors[:, :3], is_srgb=False)
        return MeshPart(arrays["POSITION"], faces.reshape(-1, 3), material, uv, arrays.get("NORMAL"), colors)

    def material(self, index: int, attributes: Entry) -> tuple[Material, str, Entry]:
        """Return a material, made once, the attribute with its texture coordinates, and how they are transformed."""
        source = self.item("materials", index)
        metal_rough = source.get("pbrMetallicRoughness", {})
        factor, slot = metal_rough.get("baseColorFactor", WHITE), metal_rough.get("baseColorTexture", {})
        if glossy := _extension(source, "KHR_materials_pbrSpecularGlossiness"):
            factor, slot = glossy.get("diffuseFactor", WHITE), glossy.get("diffuseTexture", {})
        moved = dict(_extension(slot, "KHR_texture_transform"))
        uv_name = f"TEXCOORD_{moved.pop('texCoord', slot.get('texCoord', 0))}"
        key = index, uv_name in attributes
        if key not in self.materials:
            name, texture, wrap = str(source.get("name", "unnamed")), None, None
            left_out = [each for each in _LEFT_OUT if each in {*source, *metal_rough}]
            left_out += ["emissiveFactor"] if any(source.get("emissiveFactor", ())) else []
            left_out += ["metallicFactor"] if metal_rough.get("metallicFactor", 0) > 0.5 else []
            if left_out:
                self.assets.say(f"left out of materials: {', '.join(left_out)}")
            if source.get("alphaMode", "OPAQUE") != "OPAQUE":
                self.assets.say("transparent materials are drawn opaque")
            if slot and not key[1]:
                self.assets.say("a texture without texture coordinates is left out")
            elif slot:
                texture, wrap = self.texture(slot["index"])
            red, green, blue = map(float, factor[:3])
            self.materials[key] = Material(name, (red, green, blue), texture)
            self.wraps |= {self.materials[key]: wrap} if wrap else {}
        return self.materials[key], uv_name, moved

    def texture(self, index: int) -> tuple[np.ndarray, tuple[Wrap, Wrap]]:
        """Return a texture's pixels and how it continues along u and v."""
        entry = self.item("textures", index)
        sources = [*(_extension(entry, name).get("source") for name in _IMAGE_EXTENSIONS), entry.get("source")]
        source = next((source for source in sources if source is not None), None)
        if source is None:
            _refuse_extension(next(iter(entry.get("extensions", {})), "a texture without an image"), self.assets)
        image = self.item("images", source)
        is_file = "uri" in image
        data = self.assets.read(image["uri"], is_picture=True) if is_file else bytes(self.view(image["bufferView"]))
        sampler = self.item("samplers", entry["sampler"]) if "sampler" in entry else {}
        if sampler.get("magFilter") == 9728:
            self.assets.say("textures whose texels are to look like blocks are drawn smooth")
        wrap = _WRAPS.get(sampler.get("wrapS", 0), "repeat"), _WRAPS.get(sampler.get("wrapT", 0), "repeat")
        return self.assets.texture(data, str(image.get("name", image.get("uri", source)))[:80]), wrap

    def array(self, index: int, is_share: bool = False) -> np.ndarray:
        """Return an accessor's count×width numbers; normalized integers (or all integers, if `is_share`) as floats."""
        accessor = self.item("accessors", index)
        kind, shape = np.dtype(_TYPES[accessor["componentType"]]), (accessor["count"], _WIDTHS[accessor["type"]])
        values = self.rows(accessor, kind, shape) if "bufferView" in accessor else np.zeros(shape, kind)
        if sparse := accessor.get("sparse"):
            values, places = values.copy(), sparse["indices"]
            places = self.rows(places, np.dtype(_TYPES[places["componentType"]]), (sparse["count"], 1))[:, 0]
            values[places] = self.rows(sparse["values"], kind, (sparse["count"], shape[1]))
        if kind.kind != "f" and (is_share or accessor.get("normalized")):
            return np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def rows(self, entry: Entry, kind: np.dtype, shape: tuple[int, int]) -> np.ndarray:
        """Return an array in a buffer view, from the entry's offset on; numpy raises where the view is too short."""
        size, data, start = shape[1] * kind.itemsize, self.view(entry["bufferView"]), entry.get("byteOffset", 0)
        stride = self.item("bufferViews", entry["bufferView"]).get("byteStride", size)
        return np.ndarray(shape, kind, data, start, (max(stride, size), kind.itemsize))

    def view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.item("bufferViews", index)
        entry, start = self.item("buffers", view["buffer"]), view.get("byteOffset", 0)
        data = self.assets.read(entry["uri"]) if "uri" in entry else b"" if view["buffer"] else self.binary
        if len(data) < max(entry["byteLength"], start + view["byteLength"]):
            raise ValueError(f"a buffer of {len(data)} bytes that declares {entry['byteLength']}")
        return memoryview(data)[start : start + view["byteLength"]]

    def item(self, kind: str, index: int) -> Entry:
        """Return an entry of one of the file's lists; a ValueError if there is none."""
        entries = self.tree.get(kind, [])
        if not 0 <= index < len(entries):
            raise ValueError(f"{kind} {index} of {len(entries)}")
        return entries[index]


def _open(assets: Assets) -> tuple[Entry, bytes]:
    """Return the JSON and the binary chunk of a file whose version and extensions can be read."""
    data, binary = assets.data, b""
    if assets.path.suffix.lower() == ".glb":
        if data[:4] != b"glTF":
            raise ValueError("it does not start with glTF")
        end = 20 + int.from_bytes(data[12:16], "little")
        data, binary = data[20:end], data[end + 8 : end + 8 + int.from_bytes(data[end : end + 4], "little")]
    tree = json.loads(data, object_pairs_hook=_unique_keys)
    version = str(tree.get("asset", {}).get("version"))
    if not version.startswith("2."):
        raise Refused(f"{assets.path.name} as glTF 2.0", f"asset.version {version}", "export it again as glTF 2.0")
    data_bytes = sum(abs(view["byteLength"]) for view in tree.get("bufferViews", ()))
    zeros = sum(abs(accessor["count"]) for accessor in tree.get("accessors", ()) if "bufferView" not in accessor)
    if data_bytes > MAX_FILE_BYTES or zeros > MOST_FACES // 10:
        raise ValueError(f"it asks for {data_bytes} bytes and {zeros} zeros in memory")
    required, unknown = tree.get("extensionsRequired", []), []
    for name in dict.fromkeys([*required, *tree.get("extensionsUsed", [])]):
        entry = _EXTENSIONS.get(name)
        if name in required and (entry is None or entry.answer == "refused"):
            _refuse_extension(name, assets)
        if entry is None:
            unknown.append(name)
        elif entry.answer == "said":
            assets.say(f"the glTF extension {name} is not read: {entry.how}")
    if unknown:
        assets.say(f"glTF extensions that are not read, so that looks may differ: {summarize_names(unknown)}")
    if left_out := [key for key in ("cameras", "animations") if tree.get(key)]:
        assets.say(f"{' and '.join(left_out)} in {assets.path.name} are left out")
    return tree, binary


def _unique_keys(pairs: list[tuple[str, Any]]) -> Entry:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        raise ValueError("its JSON has a key twice")
    return entries


def _refuse_extension(name: str, assets: Assets) -> NoReturn:
    do = _EXTENSIONS[name].how if name in _EXTENSIONS else "export it without this extension"
    raise Refused(f"{assets.path.name} as glTF without extensions that are not read", name, do)


def _extension(entry: Entry, name: str) -> Entry:
    return entry.get("extensions", {}).get(name, {})


def _local(node: Entry) -> np.ndarray:
    """Return a node's own 4×4: its matrix, or translation · rotation (a quaternion x, y, z, w) · scale."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    quaternion = np.asarray(node.get("rotation", (0, 0, 0, 1)), float)
    x, y, z, w = quaternion / (np.linalg.norm(quaternion) or 1)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = (np.eye(3) + 2 * w * cross + 2 * cross @ cross) * np.asarray(node.get("scale", WHITE), float)
    matrix[:3, 3] = node.get("translation", 0)
    return matrix


def _transform_uv(uv: np.ndarray, offset=(0, 0), rotation: float = 0, scale=(1, 1), **_: Any) -> np.ndarray:
    """Return coordinates (v down) scaled, turned counter-clockwise and shifted by a KHR_texture_transform."""
    u, v = (uv * scale).T
    sine, cosine = np.sin(rotation), np.cos(rotation)
    return np.column_stack([cosine * u + sine * v, cosine * v - sine * u]) + offset
