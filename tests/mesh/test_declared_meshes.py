"""Each thing that a mesh file can declare is used, refused or said, as the readers' list says."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mesh_files import SQUARE, SQUARE_FACES, SQUARE_UV, GltfFile, data_uri
from PIL import Image

from patchproof.app.keys import declarations
from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.mesh.load_mesh import load_mesh, read_parts
from patchproof.mesh.mesh import Mesh

Case = Callable[[Path], None]
CASES: dict[str, list[Case]] = {}  # by what they declare
RNG = np.random.default_rng(5)
PIXELS = RNG.integers(0, 255, (4, 8, 3), np.uint8)
MATRIX = np.array([[0, -2, 0, 5], [1, 0, 0, 6], [0, 0, 3, 7], [0, 0, 0, 1.0]])
QUIET = "faces without a material color are taken as gray 0.5"


def case(declares: str) -> Callable[[Case], Case]:
    def register(function: Case) -> Case:
        CASES.setdefault(declares, []).append(function)
        return function

    return register


@pytest.mark.parametrize("entry", declarations("Meshes"), ids=lambda entry: f"{entry.file}: {entry.declares}")
def test_each_declaration_has_the_answer_of_the_list(entry, tmp_path):
    for number, check in enumerate(CASES[entry.declares]):
        (tmp_path / str(number)).mkdir()
        if entry.answer == "refused":
            with pytest.raises(Refused) as error:
                check(tmp_path / str(number))
            assert str(error.value).startswith("Expected ")
        else:
            check(tmp_path / str(number))


def test_no_case_is_left_over():
    assert set(CASES) == {entry.declares for entry in declarations("Meshes")}


def load(path: Path, *warnings: str) -> Mesh:
    """Load a mesh, which is said to leave out exactly that of which a warning holds a text of `warnings`."""
    mesh = load_mesh(path, 4, "y")
    said = [text for text in mesh.warnings if text != QUIET]
    assert len(said) == len(warnings) and all(word in text for word, text in zip(warnings, said, strict=True)), said
    return mesh


def triangles(mesh: Mesh) -> np.ndarray:
    """The corners F×3×3, from the lowest of all on."""
    return mesh.vertices[mesh.faces] - mesh.vertices.min(0)


def area(mesh: Mesh) -> float:
    a, b, c = triangles(mesh).swapaxes(0, 1)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def plain(folder: Path, **tree) -> Mesh:
    file = GltfFile(**tree)
    file.square()
    return load(file.write(folder / "plain.gltf"))


def texel(mesh: Mesh, u: float, v: float) -> list[int]:
    """The nearest texel of the repeated texture at the corner coordinates that 0 ≤ u, v ≤ 1 of the square got."""
    a, b, d = mesh.corner_uv[0, 0].astype(float), mesh.corner_uv[0, 1].astype(float), mesh.corner_uv[1, 2].astype(float)
    texture = mesh.materials[0].texture_srgb
    assert texture is not None
    size = np.array(texture.shape[1::-1])
    x, y = np.floor((a + u * (b - a) + (1 - v) * (d - a)) * size + 1e-5).astype(int) % size
    return texture[y, x].tolist()


# ------------------------------------------------------------------------------------------------ glTF


@case("asset.version other than 2.x")
def _(folder):
    plain(folder, asset={"version": "1.0"})


@case("extensionsRequired")
def _(folder):
    plain(folder, extensionsRequired=["KHR_gaussian_splatting"])


@case("extensionsUsed")
def _(folder):
    file = GltfFile(extensionsUsed=["KHR_materials_sheen"])
    file.square()
    load(file.write(folder / "a.gltf"), "KHR_materials_sheen")


@case("accessors: integers, normalized, strided, sparse, without a view")
def _(folder):
    file, texture = GltfFile(), np.tile(PIXELS[:1], (4, 1, 1))
    primitive = file.square(texture=texture)
    attributes = primitive["attributes"]
    attributes["TEXCOORD_0"] = file.add((SQUARE_UV * 65535).astype(np.uint16), normalized=True)
    rows = np.zeros((4, 5), np.float32)
    rows[:, 1:4] = SQUARE
    rows[2, 1:4] = 99  # the sparse accessor puts this one right
    view = file.view(rows.tobytes(), byteStride=20)
    sparse = {
        "count": 1,
        "indices": {"bufferView": file.view(bytes([0, 2]), byteLength=2), "byteOffset": 1, "componentType": 5121},
        "values": {"bufferView": file.view(SQUARE[2:3].tobytes())},
    }
    accessor = {"componentType": 5126, "count": 4, "type": "VEC3"}
    file.tree["accessors"].append({"bufferView": view, "byteOffset": 4, "sparse": sparse, **accessor})
    attributes["POSITION"] = len(file.tree["accessors"]) - 1
    normals = file.add(np.int8([[0, 0, 127]] * 4), normalized=True)
    primitive["attributes"] = attributes | {
        "NORMAL": normals,
        "COLOR_0": file.add(np.full((4, 4), 51, np.uint8), normalized=True),
    }
    mesh = load(file.write(folder / "a.gltf"))
    np.testing.assert_allclose(triangles(mesh), SQUARE[SQUARE_FACES[:, 0]].reshape(2, 3, 3))
    np.testing.assert_allclose(mesh.corner_uv, SQUARE_UV[SQUARE_FACES[:, 0]].reshape(2, 3, 2))
    np.testing.assert_allclose(mesh.corner_normal, np.broadcast_to([0, 0, 1.0], (2, 3, 3)))
    np.testing.assert_allclose(mesh.corner_color_linear, 0.2, atol=1e-6)


@case("accessors: integers, normalized, strided, sparse, without a view")
def _(folder):  # positions that are zero but for a sparse part
    file = GltfFile()
    values = {"bufferView": file.view(SQUARE[1:].tobytes())}
    indices = {"bufferView": file.view(np.uint32([1, 2, 3]).tobytes()), "componentType": 5125}
    sparse = {"count": 3, "indices": indices, "values": values}
    file.tree["accessors"].append({"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse})
    file.primitive(attributes={"POSITION": 0}, indices=file.add(SQUARE_FACES.astype(np.uint32)))
    np.testing.assert_allclose(triangles(load(file.write(folder / "a.gltf"))), triangles(plain(folder)))


@case("data shorter than declared, indices out of range or reserved")
def _(folder):
    for name, damage in {
        "buffer": lambda tree: tree["buffers"][0].update(byteLength=10**4),
        "view": lambda tree: tree["bufferViews"][0].update(byteLength=20),
        "count": lambda tree: tree["accessors"][0].update(count=5),
        "huge": lambda tree: tree["accessors"][0].update(count=2**31),
        "shorter": lambda tree: tree["accessors"][1].update(count=3),
        "negative": lambda tree: tree["nodes"][0].update(mesh=-1),
        "stride": lambda tree: tree["bufferViews"][0].update(byteStride=0) or tree["accessors"][0].update(count=10**6),
    }.items():
        file = GltfFile()
        file.square()
        tree = json.loads(file.write(folder / "a.gltf").read_text())
        damage(tree)
        (folder / "a.gltf").write_text(json.dumps(tree))
        with pytest.raises(Refused, match=r"a\.gltf"):
            load(folder / "a.gltf")
            pytest.fail(name)
    for index in (4, 65535):
        file = GltfFile()
        faces = np.uint16([0, 1, index])[:, None]
        file.primitive(attributes={"POSITION": file.add(SQUARE)}, indices=file.add(faces))
        with pytest.raises(Refused, match=str(index)):
            read_parts(file.write(folder / "a.gltf"), np.eye(3))
    raise Refused("", "", "")


@case("buffers outside of its folder")
def _(folder):
    file = GltfFile()
    file.square()
    (folder / "sub").mkdir()
    (folder / "a.bin").write_bytes(file.blob)
    file.tree["buffers"] = [{"byteLength": len(file.blob), "uri": "../a.bin"}]
    load(file.write(folder / "sub" / "a.gltf"))


@case("more vertices, faces or texels than limits")
def _(folder):
    two_nodes(nodes=[{"mesh": 0}] * 20_000, scenes=[{"nodes": list(range(20_000))}]).write(folder / "a.gltf")
    load(folder / "a.gltf")


@case("a JSON key twice")
def _(folder):
    file = GltfFile()
    file.square()
    text = file.write(folder / "a.gltf").read_text()
    (folder / "a.gltf").write_text(text.replace('"scene": 0', '"scene": 0, "scene": 0'))
    load(folder / "a.gltf")


@case("modes: triangles, strips, fans")
def _(folder):
    for mode, order in ((4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])):
        file = GltfFile()
        primitive = file.primitive(attributes={"POSITION": file.add(SQUARE[order])}, mode=mode)
        mesh = load(file.write(folder / "a.gltf"))
        assert area(mesh) == pytest.approx(8) and np.all(mesh.corner_normal[..., 2] == 1), mode
        turns = order + [order[-1]] * (2 if mode == 5 else 0)  # strips repeat corners to turn
        primitive |= {"attributes": {"POSITION": file.add(SQUARE)}, "indices": file.add(np.uint8(turns)[:, None])}
        mesh = load(file.write(folder / "a.gltf"))
        assert area(mesh) == pytest.approx(8) and np.all(mesh.corner_normal[..., 2] == 1), mode


@case("modes: points, lines")
def _(folder):
    file = GltfFile()
    file.square()
    for mode in range(4):
        file.primitive(attributes={"POSITION": 0}, mode=mode)
    assert len(load(file.write(folder / "a.gltf"), "points and lines").faces) == 2


def two_nodes(**tree) -> GltfFile:
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [0, 0, 9]}]
    file = GltfFile(**{"nodes": nodes, "scenes": [{"nodes": [0]}, {"nodes": [1]}], **tree})
    file.square()
    return file


@case("scene, scenes")
def _(folder):
    nodes = [{"mesh": 0}, {"mesh": 0, "scale": [1, 3, 1]}]
    mesh = load(two_nodes(nodes=nodes, scene=1).write(folder / "a.gltf"), "of 2 scenes only scene 1", "1 nodes")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0) / np.ptp(mesh.vertices, axis=0)[0], [1, 1.5, 0])
    file = two_nodes(nodes=nodes[:1])
    del file.tree["scene"], file.tree["scenes"]
    load(file.write(folder / "a.gltf"))


@case("nodes with meshes outside of the scene")
def _(folder):
    mesh = load(
        two_nodes(scenes=[{"nodes": [0]}]).write(folder / "a.gltf"), "1 nodes with meshes are hidden or outside"
    )
    assert len(mesh.faces) == 2


@case("node transforms, mirrored ones too")
def _(folder):
    for matrix in (MATRIX, MATRIX @ np.diag([1, 1, -1, 1]), MATRIX @ np.diag([-1, 1, 1, 1])):
        nodes = [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "matrix": matrix.T.ravel().tolist()}]
        file = GltfFile(nodes=nodes)
        file.square()
        mesh = load(file.write(folder / "a.gltf"))
        points = (np.c_[SQUARE, np.ones(4)] @ matrix.T)[:, :3]
        expected = (points - points.min(0))[SQUARE_FACES[:, 0]].reshape(2, 3, 3)
        order = [0, 1, 2] if np.linalg.det(matrix) > 0 else [2, 1, 0]
        np.testing.assert_allclose(triangles(mesh), expected[:, order], atol=1e-6)
    nodes = [{"children": [1], "mesh": 0}, {"children": [0]}]
    with pytest.raises(Refused):
        plain(folder, nodes=nodes)


@case("morph targets with weights")
def _(folder):
    for place, weights in (("nodes", [0.5]), ("meshes", [0.5]), ("meshes", [0.0])):
        file = GltfFile()
        file.square(targets=[{"POSITION": file.add(np.float32([[0, 0, 0]] * 2 + [[0, 2, 0]] * 2))}])
        file.tree[place][0]["weights"] = weights
        assert area(load(file.write(folder / "a.gltf"))) == pytest.approx(8 + 8 * weights[0])


@case("skins")
def _(folder):
    file = GltfFile(nodes=[{"mesh": 0, "skin": 0}, {}], skins=[{"joints": [1]}])
    file.square()
    load(file.write(folder / "a.gltf"), "skins")


@case("base color factor, texture, COLOR_0")
def _(folder):
    file = GltfFile()
    primitive = file.square(texture=PIXELS)
    file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.25, 1, 1]
    colors = np.float32(RNG.random((4, 3)))
    primitive["attributes"] |= {"COLOR_0": file.add(colors)}
    mesh = load(file.write(folder / "a.gltf"))
    assert mesh.materials[0].base_color_linear == (0.5, 0.25, 1)
    np.testing.assert_array_equal(mesh.materials[0].texture_srgb, PIXELS)
    np.testing.assert_allclose(mesh.corner_color_linear, colors[SQUARE_FACES[:, 0]].reshape(2, 3, 3))


@case("TEXCOORD_n of the base color")
def _(folder):
    file = GltfFile()
    primitive = file.square(texture=PIXELS)
    primitive["attributes"] |= {"TEXCOORD_1": file.add(SQUARE_UV / 2)}
    file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1
    mesh = load(file.write(folder / "a.gltf"))
    np.testing.assert_allclose(mesh.corner_uv, SQUARE_UV[SQUARE_FACES[:, 0]].reshape(2, 3, 2) / 2)


def sampled(u: float, size: int, mode: int) -> int:
    """The texel at u by the definitions of OpenGL's wrap modes."""
    if mode == 33071:
        return int(np.clip(np.floor(u * size), 0, size - 1))
    texel_index = int(np.floor(u * size)) % (2 * size if mode == 33648 else size)
    return min(texel_index, 2 * size - 1 - texel_index) if mode == 33648 else texel_index


@case("wrapS, wrapT")
def _(folder):
    low, high = np.array([-0.7, -1.3]), np.array([1.6, 2.2])
    for modes in ((10497, 10497), (33648, 33071), (33071, 33648), (33648, 10497)):
        file = GltfFile(samplers=[dict(zip(("wrapS", "wrapT"), modes, strict=True))])
        file.square(np.float32(low + (high - low) * SQUARE_UV), PIXELS)
        file.tree["textures"][0]["sampler"] = 0
        mesh = load(file.write(folder / "a.gltf"))
        for u, v in RNG.random((60, 2)):
            x, y = (sampled(low[i] + (high - low)[i] * (u, v)[i], (8, 4)[i], modes[i]) for i in range(2))
            assert texel(mesh, u, v) == PIXELS[y, x].tolist(), (modes, u, v)
    file = GltfFile(samplers=[{"wrapS": 33071}])
    file.square(SQUARE_UV * np.float32(1e5), PIXELS)
    file.tree["textures"][0]["sampler"] = 0
    load(file.write(folder / "a.gltf"), "repeated, not clamped")


@case("magFilter NEAREST")
def _(folder):
    file = GltfFile(samplers=[{"magFilter": 9728}])
    file.square(texture=PIXELS)
    file.tree["textures"][0]["sampler"] = 0
    load(file.write(folder / "a.gltf"), "smooth")


@case("images as files, data URIs, buffer views")
def _(folder):
    (folder / "sub").mkdir()
    Image.fromarray(PIXELS).save(folder / "my picture.png")
    png = (folder / "my picture.png").read_bytes()
    for image in ({"uri": "../my%20picture.png"}, {"uri": data_uri(PIXELS)}, {"mimeType": "image/png"}):
        file = GltfFile()
        file.square(texture=PIXELS)
        file.tree["images"] = [image if "uri" in image else image | {"bufferView": file.view(png)}]
        mesh = load(file.write(folder / "sub" / "a.gltf"))
        np.testing.assert_array_equal(mesh.materials[0].texture_srgb, PIXELS)


def with_material(folder: Path, *said: str, tree: dict | None = None, **material) -> Mesh:
    file = GltfFile(**(tree or {}), materials=[{"name": "skin", **material}])
    file.square(material=0)
    return load(file.write(folder / "a.gltf"), *said)


@case("alphaMode MASK, BLEND")
def _(folder):
    for mode in ("MASK", "BLEND"):
        with_material(folder, "drawn opaque", alphaMode=mode, alphaCutoff=0.3)


@case("doubleSided")
def _(folder):
    with_material(folder, doubleSided=True)


@case("emission, metal, maps of normals, roughness and occlusion")
def _(folder):
    with_material(folder, "materials: emissiveFactor", emissiveFactor=[0, 1, 0])
    maps = {"normalTexture": {"index": 0}, "emissiveTexture": {"index": 0}}
    with_material(folder, "materials: normalTexture, emissiveTexture", **maps)
    with_material(folder, "materials: metallicFactor", pbrMetallicRoughness={"metallicFactor": 1})
    with_material(folder, pbrMetallicRoughness={"metallicFactor": 0}, emissiveFactor=[0, 0, 0])


@case("cameras, animations")
def _(folder):
    file = GltfFile(cameras=[{"type": "perspective"}], animations=[{"channels": []}])
    file.square()
    load(file.write(folder / "a.gltf"), "cameras and animations")


@case("KHR_mesh_quantization")
def _(folder):
    tree = {"extensionsRequired": ["KHR_mesh_quantization"], "nodes": [{"mesh": 0, "scale": [2, 2, 2]}]}
    file = GltfFile(**tree)
    positions, uv = file.add(np.int16(SQUARE * 100)), file.add(np.int8(SQUARE_UV * 3))
    normals = file.add(np.int8([[0, 0, 127]] * 4), normalized=True)
    attributes = {"POSITION": positions, "TEXCOORD_0": uv, "NORMAL": normals}
    file.primitive(attributes=attributes, indices=file.add(SQUARE_FACES))
    mesh = load(file.write(folder / "a.gltf"))
    np.testing.assert_allclose(triangles(mesh), triangles(plain(folder)))
    np.testing.assert_allclose(mesh.corner_uv, 3 * SQUARE_UV[SQUARE_FACES[:, 0]].reshape(2, 3, 2))


@case("KHR_texture_transform")
def _(folder):
    # of the specification's example: the lower left quadrant of the image, turned
    file = GltfFile(extensionsRequired=["KHR_texture_transform"])
    primitive = file.square(texture=PIXELS)
    primitive["attributes"] |= {
        "TEXCOORD_1": primitive["attributes"]["TEXCOORD_0"],
        "TEXCOORD_0": file.add(0 * SQUARE_UV),
    }
    transform = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5], "texCoord": 1}
    slot = file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    slot["extensions"] = {"KHR_texture_transform": transform}
    uv = load(file.write(folder / "a.gltf")).corner_uv
    assert uv[..., 0].min() >= -1e-6 and uv[..., 0].max() <= 0.5 + 1e-6
    assert uv[..., 1].min() >= 0.5 - 1e-6 and uv[..., 1].max() <= 1 + 1e-6
    transform |= {"offset": [0.25, -0.5], "rotation": 0, "scale": [2, -3]}
    uv = load(file.write(folder / "a.gltf")).corner_uv
    np.testing.assert_allclose(uv, (SQUARE_UV * [2, -3] + [0.25, -0.5])[SQUARE_FACES[:, 0]].reshape(2, 3, 2), atol=1e-6)


@case("EXT_mesh_gpu_instancing")
def _(folder):
    file = GltfFile(extensionsRequired=["EXT_mesh_gpu_instancing"])
    file.square()
    attributes = {
        "TRANSLATION": file.add(np.float32([[0, 0, 0], [0, 0, 5], [9, 0, 0]])),
        "ROTATION": file.add(np.int16([[0, 0, 0, 32767], [0, 0, 23170, 23170], [0, 0, 0, 32767]]), normalized=True),
        "SCALE": file.add(np.float32([[1, 1, 1], [1, 1, 1], [1, 2, 1]])),
    }
    file.tree["nodes"][0] |= {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}, "scale": [1, 1, 2]}
    mesh = load_mesh(file.write(folder / "a.gltf"), 15, "y")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [15, 4, 10], atol=1e-3)
    assert area(mesh) == pytest.approx(8 + 8 + 16, rel=1e-4) and len(mesh.materials) == 1


@case("KHR_node_visibility")
def _(folder):
    hidden = {"children": [1], "extensions": {"KHR_node_visibility": {"visible": False}}}
    nodes = [hidden, {"mesh": 0, "translation": [0, 0, 9]}, {"mesh": 0}]
    file = GltfFile(nodes=nodes, scenes=[{"nodes": [0, 2]}], extensionsUsed=["KHR_node_visibility"])
    file.square()
    assert len(load(file.write(folder / "a.gltf"), "1 nodes with meshes are hidden").faces) == 2


@case("KHR_materials_pbrSpecularGlossiness")
def _(folder):
    file = GltfFile(extensionsUsed=["KHR_materials_pbrSpecularGlossiness"])
    file.square(texture=PIXELS)
    glossy = {"diffuseFactor": [0.5, 0.125, 1, 1], "diffuseTexture": {"index": 0}}
    file.tree["materials"] = [{"extensions": {"KHR_materials_pbrSpecularGlossiness": glossy}}]
    (material,) = load(file.write(folder / "a.gltf")).materials
    assert material.base_color_linear == (0.5, 0.125, 1)
    np.testing.assert_array_equal(material.texture_srgb, PIXELS)


def _image_extension(name: str, format_name: str) -> Case:
    def check(folder: Path) -> None:
        file = GltfFile(extensionsRequired=[name])
        file.square(texture=PIXELS)
        green = np.full((16, 16, 3), (60, 180, 90), np.uint8)
        file.tree["images"] = [{"uri": data_uri(PIXELS)}, {"uri": data_uri(green, format_name)}]
        file.tree["textures"] = [{"source": 0, "extensions": {name: {"source": 1}}}]
        texture = load(file.write(folder / "a.gltf")).materials[0].texture_srgb
        np.testing.assert_allclose(texture, green, atol=8)  # AVIF is lossy

    return check


case("EXT_texture_webp")(_image_extension("EXT_texture_webp", "WEBP"))
case("EXT_texture_avif")(_image_extension("EXT_texture_avif", "AVIF"))


def _said_extension(name: str) -> Case:
    return lambda folder: with_material(folder, name, tree={"extensionsUsed": [name]}) and None


for extension in ("KHR_materials_unlit", "KHR_materials_variants", "KHR_lights_punctual"):
    case(extension)(_said_extension(extension))


@case("KHR_draco_mesh_compression")
def _(folder):
    plain(folder, extensionsRequired=["KHR_draco_mesh_compression"])


@case("KHR_draco_mesh_compression")
def _(folder):  # not required, and nothing to fall back on
    file = GltfFile(extensionsUsed=["KHR_draco_mesh_compression"])
    file.square(extensions={"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}})
    load(file.write(folder / "fallback.gltf"))
    del file.tree["accessors"][0]["bufferView"]
    load(file.write(folder / "a.gltf"))


def _compressed(name: str) -> Case:
    def check(folder: Path) -> None:
        file = GltfFile(extensionsRequired=[name])
        file.square()
        file.tree["buffers"] = [{"byteLength": len(file.blob), "extensions": {name: {"fallback": True}}}]
        with pytest.raises(Refused, match=name):
            load(file.write(folder / "a.gltf"))
        del file.tree["extensionsRequired"]
        load(file.write(folder / "a.gltf"))

    return check


for extension in ("EXT_meshopt_compression", "KHR_meshopt_compression"):
    case(extension)(_compressed(extension))


@case("KHR_texture_basisu")
def _(folder):
    file = GltfFile(extensionsUsed=["KHR_texture_basisu"])
    file.square(texture=PIXELS)
    file.tree["textures"] = [{"source": 0, "extensions": {"KHR_texture_basisu": {"source": 1}}}]
    load(file.write(folder / "fallback.gltf"))
    del file.tree["textures"][0]["source"]
    load(file.write(folder / "a.gltf"))


# ------------------------------------------------------------------------------------------------ OBJ and MTL

OUTLINE = [(0, 0), (4, 0), (4, 2), (3, 2), (3, 1), (1, 1), (1, 2), (0, 2)]  # a U of area 6
VERTICES = "".join(f"v {x} {y} 0\n" for x, y in OUTLINE)
SQUARE_OBJ = "v 0 0 0\nv 4 0 0\nv 4 2 0\nv 0 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"


def obj(folder: Path, text: str, mtl: str = "", *said: str) -> Mesh:
    (folder / "m.mtl").write_text(mtl)
    (folder / "a.obj").write_text(("mtllib m.mtl\nusemtl skin\n" if mtl else "") + text)
    return load(folder / "a.obj", *said)


def mapped(folder: Path, line: str, *said: str) -> Mesh:
    Image.fromarray(PIXELS).save(folder / "t.png")
    return obj(folder, SQUARE_OBJ + FACE, f"newmtl skin\nKd 1 1 1\nmap_Kd {line}\n", *said)


@case("polygons, concave ones too")
def _(folder):
    for shift in range(8):
        order = np.roll(np.arange(8), shift)
        u_shape = " ".join(str(i + 1) for i in order)
        mesh = obj(folder, f"{VERTICES}f {u_shape}\n")
        assert area(mesh) == pytest.approx(6) and np.all(mesh.corner_normal[..., 2] == 1)
        arrow = np.array(["1 2 3 9".split()[i % 4] for i in range(shift, shift + 4)])
        mesh = obj(folder, f"{VERTICES}v 3.5 0.5 0\nf {' '.join(arrow)}\n")  # a quad with a dent
        assert len(mesh.faces) == 2 and np.all(mesh.corner_normal[..., 2] == 1)
        rows = "\n".join(f"{x} {y} 0" for x, y in OUTLINE)
        head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
        head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        (folder / "a.ply").write_text(f"{head}{rows}\n8 {' '.join(map(str, order))}\n")
        mesh = load(folder / "a.ply")
        assert area(mesh) == pytest.approx(6) and np.all(mesh.corner_normal[..., 2] == 1)


@case("relative indices")
def _(folder):
    mesh = obj(folder, "v 0 0 0\nv 4 0 0\nv 0 2 0\nf -3 -2 -1\nv 0 0 9\nv 9 9 9\nf 1 -4 -2\n")
    assert len(mesh.faces) == 2 and np.ptp(mesh.vertices[:, 2]) == 4


@case("indices of nothing, faces with two corners")
def _(folder):
    for line in ("f 1 2 9\n", "f 0 1 2\n", "f 1/9 2/1 3/1\n", "f 1//7 2//7 3//7\n", "f 1 2\n", "f -9 1 2\n"):
        with pytest.raises(Refused, match=r"a\.obj"):
            obj(folder, SQUARE_OBJ + line)
    raise Refused("", "", "")


@case("vertex colors after v")
def _(folder):
    colored = "v 0 0 0 1 0 0\nv 4 0 0 0 0.5 0\nv 0 2 0 0 0 0\nf 1 2 3\n"
    mesh = obj(folder, colored)
    np.testing.assert_allclose(mesh.corner_color_linear[0, 1], [0, linear_from_srgb(np.float64(0.5)), 0], atol=1e-6)
    obj(folder, colored + "v 9 9 9\n", "", "colors of only some vertices")


@case("weights w, smoothing groups")
def _(folder):
    obj(folder, "v 0 0 0 1\nv 4 0 0 2\nv 0 2 0 1\nf 1 2 3\n", "", "weights of vertices")
    obj(folder, SQUARE_OBJ + "s 1\n" + FACE, "", "smoothing groups")
    obj(folder, SQUARE_OBJ + "s off\ng a b\no name\n" + FACE)


@case("points, lines, curves, surfaces, unknown lines")
def _(folder):
    obj(folder, SQUARE_OBJ + FACE + "l 1 2\nl 2 3\np 1\ncurv 0 1 1 2\n", "", "2 × l, 1 × p, 1 × curv")


@case("several mtllib lines, several names in one")
def _(folder):
    (folder / "my red.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (folder / "b.mtl").write_text("newmtl blue\nKd 0 0 1\n")
    (folder / "c.mtl").write_text("newmtl green\nKd 0 1 0\n")
    faces = "usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4\nusemtl green\nf 1 2 4\n"
    (folder / "a.obj").write_text("mtllib my red.mtl\nmtllib b.mtl \\\nc.mtl\n" + SQUARE_OBJ + faces)
    colors = [material.base_color_linear for material in load_mesh(folder / "a.obj", 4, "y").materials]
    assert colors == [(1, 0, 0), (0, 0, 1), (0, 1, 0)]


@case("text in UTF-16, or neither in it nor in UTF-8")
def _(folder):
    for encoding in ("utf-16", "gbk"):
        (folder / "m.mtl").write_text("newmtl 红\nKd 1 0 0\nnewmtl 绿\nKd 0 1 0\n", encoding)
        text = "mtllib m.mtl\n" + SQUARE_OBJ + "usemtl 红\nf 1 2 3\nusemtl 绿\nf 1 3 4\n"
        (folder / "a.obj").write_text(text, encoding)
        colors = [material.base_color_linear for material in load_mesh(folder / "a.obj", 4, "y").materials]
        assert colors == [(1, 0, 0), (0, 1, 0)]


@case("a missing MTL file, usemtl that none defines")
def _(folder):
    obj(folder, SQUARE_OBJ + "usemtl gold\n" + FACE, "", "no MTL file defines gold")
    text = "mtllib none.mtl\n" + SQUARE_OBJ + "usemtl gold\n" + FACE
    obj(folder, text, "", "the material file none.mtl is missing", "no MTL file defines gold")


@case("mtllib outside of its folder")
def _(folder):
    (folder / "sub").mkdir()
    (folder / "m.mtl").write_text("newmtl skin\nKd 1 0 0\n")
    (folder / "sub" / "a.obj").write_text("mtllib ../m.mtl\n" + SQUARE_OBJ + FACE)
    load(folder / "sub" / "a.obj", "the material file ../m.mtl is missing in the folder of a.obj")


@case("Kd, map_Kd")
def _(folder):
    Image.fromarray(PIXELS).save(folder / "my t.png")
    for kd, factor in (("Kd 0.5 1 0", [0.5, 1, 0]), ("Kd 0.5", [0.5] * 3), ("Kd 0 0 0", [1, 1, 1]), ("", [1, 1, 1])):
        (material,) = obj(folder, SQUARE_OBJ + FACE, f"newmtl skin\n{kd}\nmap_Kd my t.png\n").materials
        np.testing.assert_allclose(material.base_color_linear, linear_from_srgb(np.array(factor, float)))
        np.testing.assert_array_equal(material.texture_srgb, PIXELS)
    obj(folder, SQUARE_OBJ + FACE, "newmtl skin\nKd spectral a.rfl\n", "Kd spectral a.rfl of skin is not read")
    obj(folder, SQUARE_OBJ + FACE, "newmtl skin\nKd 255 128 0\n", "Kd 255 128 0 of skin is cut at 1")


@case("map_Kd relative to its MTL")
def _(folder):
    (folder / "sub").mkdir()
    Image.fromarray(PIXELS).save(folder / "sub" / "t.png")
    (folder / "sub" / "m.mtl").write_text("newmtl skin\nmap_Kd t.png\n")
    (folder / "a.obj").write_text("mtllib sub/m.mtl\nusemtl skin\n" + SQUARE_OBJ + FACE)
    np.testing.assert_array_equal(load(folder / "a.obj").materials[0].texture_srgb, PIXELS)


@case("map_Kd -s, -o, -clamp, -mm")
def _(folder):
    flipped = SQUARE_UV[SQUARE_FACES[:, 0]].reshape(2, 3, 2) * [1, -1] + [0, 1]  # v up, as in the file
    for line, uv in {
        "-s 2 3 1 t.png": flipped * [2, 3],
        "-o -0.25 0.5 0 t.png": flipped + np.array([-0.25, 0.5]),
        "-o 0.5 -s 2 t.png": flipped * [2, 1] + [0.5, 0],
    }.items():
        np.testing.assert_allclose(mapped(folder, line).corner_uv, uv * [1, -1] + [0, 1], atol=1e-6)
    darker = mapped(folder, "-mm 0.1 0.5 t.png").materials[0].texture_srgb
    np.testing.assert_allclose(darker, 25.5 + PIXELS / 2, atol=0.51)
    mesh = mapped(folder, "-clamp on -s 2 2 1 -o -0.5 -0.5 t.png")
    for u, v in RNG.random((40, 2)):
        x, y = sampled(2 * u - 0.5, 8, 33071), sampled(2 * v - 0.5, 4, 33071)
        assert texel(mesh, u, v) == PIXELS[y, x].tolist()


@case("map_Kd with other options")
def _(folder):
    mapped(folder, "-t 1 1 1 -texres 64 -imfchan l t.png", "map_Kd -t, map_Kd -texres, map_Kd -imfchan")
    mapped(folder, "-blendu on -clamp off -boost 0 -t 0 0 0 -mm 0 1 t.png")


@case("d, Tr, map_d")
def _(folder):
    for line in ("d 0.5", "Tr 0.5", "d -halo 0.5", "map_d t.png"):
        obj(folder, SQUARE_OBJ + FACE, f"newmtl skin\nKd 1 1 1\n{line}\n", "drawn opaque")
    obj(folder, SQUARE_OBJ + FACE, "newmtl skin\nKd 1 1 1\nTr 1.0\nd 1.0\n")


@case("Ke, other maps")
def _(folder):
    obj(
        folder,
        SQUARE_OBJ + FACE,
        "newmtl skin\nKd 1 1 1\nKe 0 1 0\nbump b.png\nmap_Ks c.png\n",
        "materials: bump, map_ks, Ke",
    )
    obj(folder, SQUARE_OBJ + FACE, "newmtl skin\nKd 1 1 1\nKe 0.0 0 0\nKs 1 1 1\nNs 10\nillum 2\n")


# ------------------------------------------------------------------------------------------------ PLY and STL

XYZ = [("float", "x"), ("float", "y"), ("float", "z")]
CODES = {"float": "f", "double": "d", "uchar": "B", "ushort": "H", "int": "i", "char": "b"}


def ply(folder: Path, elements: dict, form: str = "ascii", comments: str = "") -> Path:
    """Write elements {name: (properties, rows)}; a property (length, kind, name) takes a list."""
    head, body = f"ply\nformat {form} 1.0\n{comments}", b""
    order = ">" if "big" in form else "<"
    for name, (properties, rows) in elements.items():
        head += f"element {name} {len(rows)}\n"
        head += "".join(f"property {'list ' if len(p) == 3 else ''}{' '.join(p)}\n" for p in properties)
        for row in rows:
            for (*kinds, _), value in zip(properties, row, strict=True):
                values = [value] if len(kinds) == 1 else [len(value), *value]
                codes = [kinds[-1]] * len(values) if len(kinds) == 1 else [kinds[0]] + [kinds[1]] * len(value)
                for code, number in zip(codes, values, strict=True):
                    body += f"{number} ".encode() if form == "ascii" else struct.pack(order + CODES[code], number)
            body += b"\n" if form == "ascii" else b""
    path = folder / "a.ply"
    path.write_bytes(head.encode() + b"end_header\n" + body)
    return path


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
SQUARE_ROWS = [tuple(map(float, row)) for row in SQUARE]
POLYGONS = ([("uchar", "int", "vertex_indices")], [([0, 1, 2],), ([0, 2, 3, 4],)])  # of unequal lengths


@case("texture coordinates of vertices or of faces' corners")
def _(folder):
    expected = (SQUARE_UV * [1, -1] + [0, 1])[SQUARE_FACES[:, 0]].reshape(2, 3, 2)
    faces = SQUARE_FACES[:, 0].reshape(2, 3).tolist()
    for form in FORMS:
        rows = [(*row, *map(float, uv)) for row, uv in zip(SQUARE_ROWS, SQUARE_UV, strict=True)]
        properties = [*XYZ, ("float", "s"), ("double", "t")]
        elements = {"vertex": (properties, rows), "face": ([("uchar", "int", "vertex_index")], [(f,) for f in faces])}
        np.testing.assert_allclose(load(ply(folder, elements, form)).corner_uv, expected)
        corners = [(face, SQUARE_UV[face].ravel().tolist()) for face in faces]
        properties = [("uchar", "int", "vertex_indices"), ("uchar", "float", "texcoord")]
        mesh = load(ply(folder, {"vertex": (XYZ, SQUARE_ROWS), "face": (properties, corners)}, form))
        np.testing.assert_allclose(mesh.corner_uv, expected)
        np.testing.assert_allclose(triangles(mesh), SQUARE[faces])
        mesh = load(ply(folder, {"vertex": (XYZ, [*SQUARE_ROWS, (-1.0, 1.0, 0.0)]), "face": POLYGONS}, form))
        assert area(mesh) * (5 / 4) ** 2 == pytest.approx(9)  # a longest side of 5, drawn as 4


def textured_ply(folder: Path, comments: str) -> Path:
    Image.fromarray(PIXELS).save(folder / "my t.png")
    rows = [(*row, *map(float, uv)) for row, uv in zip(SQUARE_ROWS, SQUARE_UV, strict=True)]
    elements = {"vertex": ([*XYZ, ("float", "u"), ("float", "v")], rows), "face": (POLYGONS[0], [([0, 1, 2, 3],)])}
    return ply(folder, elements, comments=comments)


@case("one texture")
def _(folder):
    mesh = load(textured_ply(folder, "comment TextureFile my t.png\n"))
    np.testing.assert_array_equal(mesh.materials[0].texture_srgb, PIXELS)
    with pytest.raises(Refused, match=r"b\.png"):
        load(textured_ply(folder, "comment TextureFile b.png\n"))


@case("several textures")
def _(folder):
    load(textured_ply(folder, "comment TextureFile my t.png\ncomment TextureFile b.png\n"))


@case("colors of vertices or faces, of any type")
def _(folder):
    for form in FORMS:
        for kind, top in (("uchar", 255), ("ushort", 65535), ("float", 1.0)):
            colors = [(kind, name) for name in ("red", "green", "blue", "alpha")]
            half = 0.2 if kind == "float" else top // 5
            rows = [(*row, top, half, 0, top) for row in SQUARE_ROWS]
            mesh = load(ply(folder, {"vertex": ([*XYZ, *colors], rows), "face": (POLYGONS[0], [([0, 1, 2],)])}, form))
            expected = [1, linear_from_srgb(np.float64(0.2)), 0]
            np.testing.assert_allclose(mesh.corner_color_linear[0], [expected] * 3, atol=1e-6)
            faces = ([*POLYGONS[0], *colors], [([0, 1, 2], top, half, 0, top), ([0, 2, 3], 0, 0, 0, 0)])
            mesh = load(ply(folder, {"vertex": (XYZ, SQUARE_ROWS), "face": faces}, form), "drawn opaque")
            np.testing.assert_allclose(mesh.corner_color_linear, [[expected] * 3, [[0] * 3] * 3], atol=1e-6)


@case("other elements")
def _(folder):
    elements = {
        "vertex": (XYZ, SQUARE_ROWS),
        "edge": ([("int", "vertex1")], [(0,)]),
        "face": (POLYGONS[0], [([0, 1, 2],)]),
    }
    for form in FORMS:
        load(ply(folder, elements, form), "left out of a.ply: edge")


@case("several solids")
def _(folder):
    facet = "facet normal 0 0 1\nouter loop\n{}\nendloop\nendfacet\n"
    loops = [
        facet.format("\n".join(f"vertex {x} {y:e} {z}" for x, y, z in SQUARE[face])) for face in ([0, 1, 2], [0, 2, 3])
    ]
    (folder / "a.stl").write_text("".join(f"solid part {i}\n{loop}endsolid part {i}\n" for i, loop in enumerate(loops)))
    np.testing.assert_allclose(triangles(load(folder / "a.stl")), triangles(plain(folder)))


@case("COLOR= in the header, colors of facets")
def _(folder):
    facets = [struct.pack("<12fH", 0, 0, 1, *SQUARE[face].ravel(), 0) for face in ([0, 1, 2], [0, 2, 3])]
    for head, body, said in (
        (b"solid of nothing", b"".join(facets), ()),
        (b"COLOR=\xff\x00\x00\xff", b"".join(facets), ("colors in the STL file",)),
        (b"", facets[0] + facets[1][:48] + b"\x1f\x80", ("colors in the STL file",)),
    ):
        (folder / "a.stl").write_bytes(head.ljust(80, b" ") + struct.pack("<I", 2) + body)
        np.testing.assert_allclose(triangles(load(folder / "a.stl", *said)), triangles(plain(folder)))
