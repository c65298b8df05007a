"""Meshes: what a file says is what the scene gets, and what is broken is refused or named."""

import json
import os
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import SQUARE_UV, GltfFile
from PIL import Image

import patchproof.mesh.load_mesh as mesh_loader
from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.mesh import assets
from patchproof.mesh.load_mesh import load_mesh, read_parts
from patchproof.mesh.mesh import Material, MeshPart, mesh_from_parts

DATA = os.environ.get("PATCHPROOF_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="PATCHPROOF_DATA is unset: no meshes from outside")
TRIANGLE = "v 0 0 0\nv 4 0 0\nv 0 2 0\n"


def write(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def gltf(folder: Path, positions, name="a.gltf", **extra) -> Path:
    """One triangle, or one per three positions, as glTF with its buffer beside it; `extra` joins or replaces keys."""
    arrays = {"POSITION": np.asarray(positions, np.float32), **extra.pop("attributes", {})}
    file, primitive = GltfFile(), extra.pop("primitive", {})
    numbers = {key: file.add(array, normalized=array.dtype.kind == "u") for key, array in arrays.items()}
    file.primitive(attributes=numbers, **primitive)
    file.tree |= {"buffers": [{"uri": "a.bin", "byteLength": len(file.blob)}], **extra}
    (folder / "a.bin").write_bytes(file.blob)
    return file.write(folder / name)


def face_normals(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)


def signed_volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
# corner numbers, counter-clockwise seen from outside
_CUBE = "013 032 467 475 045 051 237 276 026 064 157 173"
CUBE_FACES = np.array([[int(digit) for digit in face] for face in _CUBE.split()])


# ------------------------------------------------------------------------------------------------ size and axes


def test_longest_extent_is_length_and_the_box_is_centered(tmp_path):
    mesh = load_mesh(write(tmp_path, "a.obj", TRIANGLE + "f 1 2 3\n"), 100, "y")
    np.testing.assert_allclose(mesh.vertices, [[-50, -25, 0], [50, -25, 0], [-50, 25, 0]])


def test_z_up_turns_x_y_z_into_x_z_minus_y(tmp_path):
    file = write(tmp_path, "a.obj", "v 0 0 0\nv 4 0 0\nv 0 2 1\nvn 0 0 1\nf 1//1 2//1 3//1\n")
    mesh = load_mesh(file, 4, "z")
    np.testing.assert_allclose(mesh.vertices - mesh.vertices[0], [[0, 0, 0], [4, 0, 0], [0, 1, -2]])
    np.testing.assert_allclose(mesh.corner_normal[0], np.tile([0, 1, 0], (3, 1)), atol=1e-7)


def test_unused_and_far_vertices_do_not_count(tmp_path):
    mesh = load_mesh(write(tmp_path, "a.obj", TRIANGLE + "v 900 900 900\nv nan 1 2\nf 1 2 3\n"), 4, "y")
    assert len(mesh.vertices) == 3 and mesh.warnings == ("faces without a material color are taken as gray 0.5",)


def test_faces_stay_outward_when_parts_are_closed():
    gray = Material("m", (0.5, 0.5, 0.5))
    mesh = mesh_from_parts([MeshPart(CUBE, CUBE_FACES, gray)], 10)
    assert signed_volume(mesh) == pytest.approx(1000)
    np.testing.assert_allclose(mesh.corner_normal[:, 0], face_normals(mesh), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1.0, 1e30, 1e300])
def test_any_unit_will_do(scale):
    mesh = mesh_from_parts([MeshPart(CUBE * scale, CUBE_FACES, Material("m", (1, 1, 1)))], 10)
    assert signed_volume(mesh) == pytest.approx(1000) and len(mesh.faces) == 12


@pytest.mark.parametrize("mirror", [1, -1])
def test_transforms_apply_and_a_mirror_keeps_faces_outward(tmp_path, mirror):
    corners = CUBE[CUBE_FACES].reshape(-1, 3)
    normal = np.repeat(
        face_normals(mesh_from_parts([MeshPart(CUBE, CUBE_FACES, Material("", (1, 1, 1)))], 1)), 3, axis=0
    )
    nodes = [
        {"children": [1], "scale": [mirror, 1, 2], "translation": [5, 6, 7]},
        {"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]},
    ]
    file = gltf(tmp_path, corners, attributes={"NORMAL": normal.astype(np.float32)}, nodes=nodes)
    mesh = load_mesh(file, 2, "y")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [1, 1, 2], atol=1e-6)
    assert signed_volume(mesh) == pytest.approx(2, abs=1e-5)
    np.testing.assert_allclose(mesh.corner_normal, np.repeat(face_normals(mesh)[:, None], 3, axis=1), atol=1e-6)


def test_normals_follow_the_inverse_transpose(tmp_path):
    n = np.float32([[1, 1, 0]] * 3) / np.float32(np.sqrt(2))
    file = gltf(
        tmp_path, [[0, 0, 0], [0, 0, 1], [1, -1, 0]], attributes={"NORMAL": n}, nodes=[{"mesh": 0, "scale": [2, 1, 1]}]
    )
    mesh = load_mesh(file, 1, "y")
    np.testing.assert_allclose(mesh.corner_normal[0, 0], np.array([1, 2, 0]) / np.sqrt(5), atol=1e-6)
    assert abs(mesh.corner_normal[0, 0] @ (mesh.vertices[2] - mesh.vertices[0])) < 1e-6


def test_a_mesh_placed_twice_comes_twice_with_one_material(tmp_path):
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]
    file = gltf(tmp_path, [[0, 0, 0], [1, 0, 0], [0, 1, 0]], nodes=nodes, scenes=[{"nodes": [0, 1]}])
    mesh = load_mesh(file, 4, "y")
    assert len(mesh.faces) == 2 and len(mesh.materials) == 1
    np.testing.assert_allclose(np.abs(mesh.vertices[3:] - mesh.vertices[:3]), np.tile([3, 0, 0], (3, 1)), atol=1e-6)


def test_quads_and_polygons_become_triangles_of_the_same_area(tmp_path):
    square = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nv 1 3 0\n"
    quad = load_mesh(write(tmp_path, "q.obj", square + "f 1 2 3 4\n"), 2, "y")
    mixed = load_mesh(write(tmp_path, "p.obj", square + "f 1 2 3 5 4\nf 1 2 3\n"), 3, "y")
    assert len(quad.faces) == 2 and len(mixed.faces) == 4
    assert np.all(face_normals(quad)[:, 2] == 1) and np.all(face_normals(mixed)[:, 2] == 1)


# ------------------------------------------------------------------------------------------------ colors and textures


def textured_obj(folder: Path, mtl: str = "newmtl red\nKd 1 1 1\nmap_Kd t.png\n") -> Path:
    pixels = np.arange(4 * 2 * 3, dtype=np.uint8).reshape(4, 2, 3) * 9
    Image.fromarray(pixels).save(folder / "t.png")
    write(folder, "m.mtl", mtl)
    uv = "vt 0.25 0.9\nvt 1.5 0.9\nvt 0.25 -2\n"
    return write(folder, "a.obj", "mtllib m.mtl\n" + TRIANGLE + uv + "usemtl red\nf 1/1 2/2 3/3\n")


def test_texture_pixels_and_wrapped_coordinates_with_v_down(tmp_path):
    mesh = load_mesh(textured_obj(tmp_path), 4, "y")
    np.testing.assert_allclose(mesh.corner_uv[0], [[0.25, 0.1], [1.5, 0.1], [0.25, 3]], atol=1e-6)
    np.testing.assert_array_equal(mesh.materials[0].texture_srgb, np.asarray(Image.open(tmp_path / "t.png")))
    assert mesh.materials[0].base_color_linear == (1, 1, 1) and mesh.warnings == ()


def test_a_comment_behind_a_face_takes_no_texture_away(tmp_path):
    file = textured_obj(tmp_path)
    file.write_text(file.read_text().replace("3/3\n", "3/3 # see http://example.org/a-b\n"))
    assert load_mesh(file, 4, "y").materials[0].texture_srgb is not None


def test_gltf_coordinates_are_v_down_already_and_its_color_is_linear_to_the_last_digit(tmp_path):
    uv = np.float32([[0.25, 0.1], [1.5, 0.1], [0.25, 3]])
    materials = [{"name": "paint", "pbrMetallicRoughness": {"baseColorFactor": [0.0012, 0.3333, 1, 1]}}]
    file = gltf(
        tmp_path,
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        attributes={"TEXCOORD_0": uv},
        materials=materials,
        primitive={"material": 0},
    )
    mesh = load_mesh(file, 4, "y")
    np.testing.assert_allclose(mesh.corner_uv[0], uv, atol=1e-6)
    assert mesh.materials[0].base_color_linear == (0.0012, 0.3333, 1) and mesh.warnings == ()


def test_kd_is_srgb_and_black_beside_a_map_means_the_map_alone(tmp_path):
    plain = load_mesh(textured_obj(tmp_path, "newmtl red\nKd 0.5 0.25 0\n"), 4, "y")
    np.testing.assert_allclose(plain.materials[0].base_color_linear, linear_from_srgb(np.array([0.5, 0.25, 0])))
    mapped = load_mesh(textured_obj(tmp_path, "newmtl red\nKd 0 0 0\nmap_Kd -s 1 1 1 t.png\n"), 4, "y")
    assert mapped.materials[0].base_color_linear == (1, 1, 1) and mapped.materials[0].texture_srgb is not None


def test_several_materials_go_to_their_own_faces(tmp_path):
    write(tmp_path, "m.mtl", "newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 0 1\n")
    file = write(
        tmp_path,
        "a.obj",
        "mtllib m.mtl\n" + TRIANGLE + "v 0 0 1\nusemtl a\nf 1 2 3\nusemtl b\nf 1 2 4\nusemtl a\nf 1 3 4\n",
    )
    mesh = load_mesh(file, 4, "y")
    colors = [mesh.materials[i].base_color_linear for i in mesh.face_material]
    normals = np.abs(face_normals(mesh)).argmax(1)
    assert sorted(zip(normals.tolist(), colors, strict=True)) == [(0, (1, 0, 0)), (1, (0, 0, 1)), (2, (1, 0, 0))]


def test_alpha_is_dropped_and_16_bit_textures_are_scaled(tmp_path):
    file = textured_obj(tmp_path)
    Image.fromarray(np.full((2, 2, 4), (10, 20, 30, 0), np.uint8)).save(tmp_path / "t.png")
    assert load_mesh(file, 4, "y").materials[0].texture_srgb[0, 0].tolist() == [10, 20, 30]
    Image.fromarray(np.full((2, 2), 0x8000, np.uint16)).save(tmp_path / "t.png")
    assert load_mesh(file, 4, "y").materials[0].texture_srgb[0, 0].tolist() == [128, 128, 128]


def test_vertex_colors_are_srgb_in_ply_and_linear_in_gltf(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    ply = write(tmp_path, "a.ply", head + "0 0 0 255 0 0\n1 0 0 0 128 0\n0 1 0 0 0 0\n3 0 1 2\n")
    mesh = load_mesh(ply, 1, "y")
    np.testing.assert_allclose(mesh.corner_color_linear[0, :, 0], [1, 0, 0], atol=1e-6)
    assert mesh.corner_color_linear[0, 1, 1] == pytest.approx(linear_from_srgb(np.float64(128 / 255)), abs=1e-6)
    assert mesh.materials[0].base_color_linear == (1, 1, 1) and mesh.warnings == ()
    for colors in (
        np.float32([[1, 0, 0], [0, 0.25, 0], [0, 0, 0]]),
        np.uint16([[65535, 0, 0, 9], [0, 16384, 0, 9], [0] * 4]),
    ):
        mesh = load_mesh(gltf(tmp_path, [[0, 0, 0], [1, 0, 0], [0, 1, 0]], attributes={"COLOR_0": colors}), 1, "y")
        np.testing.assert_allclose(mesh.corner_color_linear[0], [[1, 0, 0], [0, 0.25, 0], [0, 0, 0]], atol=1e-5)


def test_face_colors_give_every_face_corners_of_its_own(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    head += "property float z\nelement face 2\nproperty list uchar int vertex_indices\n"
    head += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    ply = write(tmp_path, "a.ply", head + "0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2 255 0 0\n3 0 1 3 0 0 255\n")
    mesh = load_mesh(ply, 1, "y")
    np.testing.assert_allclose(mesh.corner_color_linear, [[[1, 0, 0]] * 3, [[0, 0, 1]] * 3], atol=1e-6)


def test_file_normals_are_kept_and_useless_ones_replaced(tmp_path):
    file = write(tmp_path, "a.obj", TRIANGLE + "vn 0 3 4\nvn 0 0 0\nvn nan 0 1\nf 1//1 2//2 3//3\n")
    mesh = load_mesh(file, 4, "y")
    np.testing.assert_allclose(mesh.corner_normal[0], [[0, 0.6, 0.8], [0, 0, 1], [0, 0, 1]], atol=1e-6)


# ------------------------------------------------------------------------------------------------ bad input


GRAY = "faces without a material color are taken as gray 0.5"
BAD = {
    "cube_compressed.obj": GRAY,
    "empty.obj": "Expected a mesh with faces, got no face in empty.obj",
    "empty_nodes.glb": "Expected a mesh with faces, got no face in empty_nodes.glb",
    "jacked.obj": "the material file nonexistent.mtl is missing",
    "joined_tetrahedra.obj": GRAY,
    "multibody.stl": GRAY,
    "nancolor.obj": "1 vertex colors are not numbers and are taken as gray 0.5",
    "negative_indices.obj": GRAY,
    "noimg.obj": GRAY,
    "not_convex.obj": GRAY,
    "notenoughindices.obj": "Expected faces with at least three corners, got a face with 2 in line 9",
    "p3d_missing_files_obj_model.obj": "Expected a mesh whose faces have an area, got 2 faces without area",
    "p3d_missing_files_obj_model2.obj": "Expected a mesh whose faces have an area, got 2 faces without area",
    "p3d_missing_usemtl_cow.obj": "the material file cow.mtl is missing",
    "p3d_obj_mtl_no_image_model.obj": "Expected a mesh whose faces have an area, got 2 faces without area",
    "polygonfaces.obj": "the material file surface.mtl is missing",
    "singlevn.obj": "the material file surface.mtl is missing",
    "soup.stl": GRAY,
    "textured_tetrahedron.obj": GRAY,
    "wallhole.obj": "9 faces without area are left out",
}


@needs_data
@pytest.mark.parametrize("name", BAD)
def test_each_bad_file_is_refused_or_warned_about(name):
    file = Path(DATA) / "meshes" / "bad" / name
    if BAD[name].startswith("Expected"):
        with pytest.raises(Refused, match=BAD[name]):
            load_mesh(file, 100, "y")
    else:
        mesh = load_mesh(file, 100, "y")
        assert any(BAD[name] in warning for warning in mesh.warnings)
        check_usable(mesh)


@needs_data
def test_the_table_names_every_bad_file():
    assert sorted(BAD) == sorted(entry[0] for entry in json.loads((Path(DATA) / "meshes/bad/bad.json").read_text()))


def check_usable(mesh):
    assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.corner_uv).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.corner_normal, axis=2), 1, atol=1e-5)
    assert mesh.corner_color_linear.min() >= 0 and mesh.corner_color_linear.max() <= 1
    assert set(np.unique(mesh.face_material)) <= set(range(len(mesh.materials)))
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(100)
    np.testing.assert_allclose(mesh.vertices.max(0) + mesh.vertices.min(0), 0, atol=1e-9)
    assert set(mesh.faces.reshape(-1)) == set(range(len(mesh.vertices)))


@needs_data
@pytest.mark.parametrize("name", ["gz_suv", "banana_ycb", "teapot", "gz_stop_light", "gz_cardboard_box"])
def test_real_meshes_load(name):
    mesh = load_mesh(Path(DATA) / "meshes" / f"{name}.glb", 100, "z")
    check_usable(mesh)
    assert (mesh.materials[0].texture_srgb is None) == (name == "teapot")
    other = trimesh.load_scene(Path(DATA) / "meshes" / f"{name}.glb").to_mesh()  # an independent reader
    scale = 100 / np.ptp(other.vertices, axis=0).max()
    np.testing.assert_allclose(
        np.ptp(mesh.vertices, axis=0), np.ptp(other.vertices, axis=0)[[0, 2, 1]] * scale, rtol=1e-6
    )
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(other.area * scale**2, rel=1e-5)


def refused(path, *words):
    with pytest.raises(Refused) as error:
        load_mesh(path, 100, "y")
    text = str(error.value)
    assert "\n" not in text and text.startswith("Expected ") and ", got " in text and text.endswith(".")
    for word in words:
        assert word in text
    return text


def test_missing_mesh_and_unknown_format(tmp_path):
    refused(tmp_path / "none.obj", "no file at", "none.obj")
    refused(write(tmp_path, "a.docx", "x"), ".obj, .glb", "a.docx")


def test_a_named_texture_that_is_missing_or_broken_is_refused(tmp_path):
    file = textured_obj(tmp_path)
    (tmp_path / "t.png").unlink()
    refused(file, "t.png, which a.obj names", "no such file")
    file = textured_obj(tmp_path)
    whole = (tmp_path / "t.png").read_bytes()
    (tmp_path / "t.png").write_bytes(whole[: len(whole) // 2])
    refused(file, "texture")
    (tmp_path / "t.png").write_text("no picture")
    refused(file, "t.png", "texture")


def test_a_missing_or_broken_gltf_image_is_refused(tmp_path):
    extra = {
        "materials": [{"name": "paint", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "my%20picture.png"}],
        "primitive": {"material": 0},
        "attributes": {"TEXCOORD_0": np.zeros((3, 2), np.float32)},
    }
    triangle = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    refused(gltf(tmp_path, triangle, **{**extra}), "my%20picture.png")
    write(tmp_path, "my picture.png", "no picture")
    refused(gltf(tmp_path, triangle, **{**extra}), "my%20picture.png")
    Image.new("RGB", (3, 2), (9, 8, 7)).save(tmp_path / "my picture.png")
    assert load_mesh(gltf(tmp_path, triangle, **{**extra}), 1, "y").materials[0].texture_srgb[0, 0].tolist() == [
        9,
        8,
        7,
    ]


def test_a_missing_buffer_is_refused(tmp_path):
    file = gltf(tmp_path, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    (tmp_path / "a.bin").unlink()
    refused(file, "a.bin")


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.ply", "a.stl", "a.obj"])
@pytest.mark.parametrize(
    "content", [b"", b"hello, this is no mesh\n", bytes(range(256)) * 4], ids=["empty", "text", "bytes"]
)
def test_files_that_are_no_meshes(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name)


def test_a_text_gltf_does_not_open_its_neighbor(tmp_path):
    gltf(tmp_path, [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "model.gltf")
    refused(write(tmp_path, "a.gltf", "hello"), "a.gltf")


@needs_data
def test_a_truncated_glb_is_refused(tmp_path):
    data = (Path(DATA) / "meshes" / "gz_stop_sign.glb").read_bytes()
    for share in (0.01, 0.3, 0.9):
        (tmp_path / "a.glb").write_bytes(data[: int(len(data) * share)])
        refused(tmp_path / "a.glb")


def test_a_glb_that_promises_terabytes_is_refused(tmp_path):
    head = struct.pack("<4sIIII", b"glTF", 2, 2**32 - 1, 2**32 - 1, 0x4E4F534A)
    (tmp_path / "a.glb").write_bytes(head + b"{}")
    refused(tmp_path / "a.glb")


def test_nan_faces_are_dropped_and_all_nan_is_refused(tmp_path):
    mesh = load_mesh(write(tmp_path, "a.obj", TRIANGLE + "v inf 0 0\nf 1 2 3\nf 1 2 4\n"), 4, "y")
    assert len(mesh.faces) == 1 and "1 faces with NaN or infinite corners are left out" in mesh.warnings
    refused(
        write(tmp_path, "b.obj", "v nan 0 0\nv 1 nan 0\nv 0 0 nan\nf 1 2 3\n"), "faces with NaN or infinite corners"
    )


def test_flat_objects_are_allowed_and_points_are_not(tmp_path):
    assert len(load_mesh(write(tmp_path, "a.obj", TRIANGLE + "f 1 2 3\n"), 4, "y").faces) == 1
    refused(write(tmp_path, "b.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n"), "1 faces without area")
    refused(write(tmp_path, "c.obj", TRIANGLE), "no face in c.obj")


def test_indices_that_name_no_vertex(tmp_path):
    refused(write(tmp_path, "a.obj", TRIANGLE + "f 1 2 9\n"))


def test_hundreds_of_thousands_of_faces_take_no_loop(tmp_path):
    n = 400
    u, v = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0))
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, n + 1], corner[:, None] + [1, n + 2, n + 1]])
    start = time.perf_counter()
    mesh = mesh_from_parts([MeshPart(np.stack([u, v, 0 * u], -1).reshape(-1, 3), faces, Material("", (1, 1, 1)))], 1)
    assert len(mesh.faces) == 2 * n * n
    assert time.perf_counter() - start < 4  # 0.2 s when nothing else runs; a loop over 320,000 faces takes tens


def test_primitives_are_scaled_like_files():
    mesh = load_mesh("primitive:mug", 250, "z")
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(250)
    with pytest.raises(Refused, match="primitive"):
        load_mesh("primitive:nonsense", 250, "z")


def test_a_texture_of_8192_is_reduced_and_said_to_be(tmp_path):
    """What no photograph can show is not carried along; one texel is the smallest texture."""
    text = TRIANGLE + "vt 0 0\nvt 1 0\nvt 0 1\nmtllib {0}.mtl\nusemtl skin\nf 1/1 2/2 3/3\n"
    for name, size in (("large", (8192, 512)), ("small", (1, 1))):
        Image.new("RGB", size, (200, 100, 50)).save(tmp_path / f"{name}.png", compress_level=1)
        write(tmp_path, f"{name}.mtl", f"newmtl skin\nmap_Kd {name}.png\n")
    large = load_mesh(write(tmp_path, "large.obj", text.format("large")), 100, "y")
    small = load_mesh(write(tmp_path, "small.obj", text.format("small")), 100, "y")
    assert large.materials[0].texture_srgb.shape == (256, 4096, 3)
    assert large.warnings == ("the texture of 8192 × 512 of skin is reduced to 4096 × 256",)
    assert small.materials[0].texture_srgb.shape == (1, 1, 3) and small.warnings == ()
    assert large.materials[0].texture_srgb[0, 0].tolist() == small.materials[0].texture_srgb[0, 0].tolist()


# ------------------------------------------------------------------------------------------------ limits


def test_only_pictures_are_opened_outside_of_the_folder_of_a_mesh(tmp_path):
    folder = tmp_path / "given"
    (folder / "sub").mkdir(parents=True)
    file = gltf(folder, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    (folder / "a.bin").rename(tmp_path / "a.bin")
    for place, is_within in ((folder / "b.bin", True), (tmp_path / "b.bin", False)):
        place.write_bytes((tmp_path / "a.bin").read_bytes())
        (folder / "a.bin").unlink(missing_ok=True)
        (folder / "a.bin").symlink_to(place)
        if is_within:
            load_mesh(file, 1, "y")
        else:
            refused(file, "the file a.bin", "no such file in its folder")
    write(tmp_path, "m.mtl", "newmtl red\nKd 1 0 0\n")
    for name in ("../m.mtl", str(tmp_path / "m.mtl"), "link.mtl"):
        (folder / "link.mtl").unlink(missing_ok=True)
        (folder / "link.mtl").symlink_to(tmp_path / "m.mtl")
        mesh = load_mesh(write(folder, "a.obj", f"mtllib {name}\n{TRIANGLE}usemtl red\nf 1 2 3\n"), 1, "y")
        assert mesh.warnings[0] == f"the material file {name} is missing in the folder of a.obj"
    file = textured_obj(folder, "newmtl red\nmap_Kd sub/t.png\n")
    for target in ("t.jpg", "t.txt"):
        (folder / "t.png").replace(tmp_path / target)
        (folder / "sub" / "t.png").unlink(missing_ok=True)
        (folder / "sub" / "t.png").symlink_to(tmp_path / target)
        if target == "t.jpg":
            assert load_mesh(file, 1, "y").materials[0].texture_srgb.shape == (4, 2, 3)
            (tmp_path / target).replace(folder / "t.png")
    refused(file, "sub/t.png", "no such file in its folder")


def test_textures_have_a_limit_together(tmp_path, monkeypatch):
    monkeypatch.setattr(assets, "MOST_TEXELS", 100)
    file = GltfFile(samplers=[{"wrapS": 33071}])
    file.square(SQUARE_UV * np.float32([3, 1]), np.zeros((8, 8, 3), np.uint8))
    file.tree["textures"][0]["sampler"] = 0
    mesh = load_mesh(file.write(tmp_path / "a.gltf"), 1, "y")
    assert any("is repeated, not clamped: that would take 26 texels" in warning for warning in mesh.warnings)
    monkeypatch.setattr(assets, "MOST_TEXELS", 63)
    refused(file.write(tmp_path / "a.gltf"), "8 × 8 more in ")


def test_places_and_shared_vertices_count(tmp_path, monkeypatch):
    monkeypatch.setattr("patchproof.mesh.gltf.MOST_FACES", 1_000_000)  # a twentieth, which fewer places reach
    for count in (300, 2_000):  # of a square, placed, with a list of vertices of which it has four, or repeated
        file = GltfFile(nodes=[{"mesh": 0}] * count, scenes=[{"nodes": list(range(count))}])
        file.square()
        shared = GltfFile()
        points = shared.add(np.zeros((100_000, 3), np.float32))
        shared.tree["bufferViews"][points]["byteLength"] = 12 * 100_000
        primitive = {"attributes": {"POSITION": points}, "indices": shared.add(np.uint8([[0], [1], [99]]))}
        shared.tree["meshes"] = [{"primitives": [primitive] * count}]
        repeated = GltfFile()
        repeated.square()
        attributes = {"TRANSLATION": repeated.add(np.zeros((count, 3), np.float32))}
        repeated.tree["nodes"][0] |= {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}}
        for each in (file, shared, repeated):
            path = each.write(tmp_path / "a.gltf")
            if count == 2_000:
                refused(path, "million faces", "counted as often as they are placed")
            else:
                parts, *_ = read_parts(path, np.eye(3))
                assert len(parts) == count and sum(len(part.vertices) for part in parts) <= 4 * count


def test_long_words_and_long_headers_take_neither_memory_nor_minutes(tmp_path):
    corner = "vertex 0 0 0\n"
    text = f"solid a\n{corner * 3000}vertex 0 0 {'0' * 10**6}\nvertex 1 0 0\nvertex 0 1 0\nendsolid\n"
    assert len(load_mesh(write(tmp_path, "a.stl", text), 1, "y").faces) == 1
    names = "".join(f"property list uchar int p{i}\n" for i in range(20_000))
    begin = time.process_time()
    refused(write(tmp_path, "a.ply", f"ply\nformat ascii 1.0\nelement v 1\n{names}end_header\n{'0 ' * 20_000}"))
    assert time.process_time() - begin < 5


def test_an_outline_that_has_few_ears_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_loader, "SECONDS", 0.2)
    corners = np.random.default_rng(0).random((999, 2))
    text = "".join(f"v {x} {y} 0\n" for x, y in corners) + f"f {' '.join(map(str, range(1, 1000)))}\n" * 20
    refused(write(tmp_path, "a.obj", text), "a.obj", "processor time")
