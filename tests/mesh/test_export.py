"""GLB out: another reader finds the same object, and the same object gives the same bytes."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from patchproof.base.settings import PatchSettings
from patchproof.mesh.load_mesh import load_mesh, write_glb
from patchproof.scene.texture_scene import texture_canvas

rng = np.random.default_rng(0)


@pytest.fixture
def painted(tmp_path):
    """A carton on which every material has a texture of its own, exported."""
    mesh = load_mesh("primitive:carton", 300)
    textures = [rng.integers(0, 256, (6, 5 + i, 3), dtype=np.uint8) for i in range(len(mesh.materials))]
    write_glb(mesh, textures, tmp_path / "object.glb")
    return mesh, textures, tmp_path / "object.glb"


def triangles(positions, uv, textures):
    """Rows that describe each triangle whole, in an order of their own."""
    rows = np.concatenate([positions.reshape(len(positions), -1), uv.reshape(len(uv), -1), textures[:, None]], axis=1)
    return rows[np.lexsort(np.round(rows, 3).T)]


def test_our_own_reader_finds_the_same_object(painted):
    mesh, textures, path = painted
    back = load_mesh(path, 300, "y")
    assert sorted(m.name for m in back.materials) == sorted(m.name for m in mesh.materials)
    assert all(material.base_color_linear == (1, 1, 1) for material in back.materials)
    which = [material.texture_srgb.shape[1] - 5 for material in back.materials]
    assert all(np.array_equal(m.texture_srgb, textures[i]) for m, i in zip(back.materials, which, strict=True))
    written = triangles(mesh.vertices[mesh.faces], mesh.corner_uv, mesh.face_material)
    read = triangles(back.vertices[back.faces], back.corner_uv, np.array(which)[back.face_material])
    # float32 meters: 300 mm * 6e-8
    assert np.abs(written - read).max() < 1e-4
    assert np.array_equal(back.corner_color_linear, mesh.corner_color_linear[: len(back.faces)])


def test_trimesh_alone_reads_meters_and_names(painted):
    mesh, textures, path = painted
    scene = trimesh.load_scene(path)
    assert np.allclose(np.sort(scene.extents), np.sort(np.ptp(mesh.vertices, axis=0)) / 1000, rtol=1e-6)
    assert len(scene.geometry) == len(mesh.materials)
    for name, geometry in scene.geometry.items():
        index = int(name.partition("_")[0])
        picture = geometry.visual.material.baseColorTexture
        assert picture.format == "PNG" and np.array_equal(np.asarray(picture.convert("RGB")), textures[index])
        assert geometry.visual.material.name == mesh.materials[index].name
        faces = mesh.face_material == index
        assert np.isclose(geometry.area, trimesh.Trimesh(mesh.vertices, mesh.faces[faces]).area / 1e6, rtol=1e-5)
        outward = np.einsum("fc,fc->f", geometry.face_normals, geometry.vertex_normals[geometry.faces].mean(1))
        assert (outward > 0).all()  # faces and normals agree on the outside


def test_the_container_is_what_its_specification_says(painted):
    """glTF 2.0, section 4.4: header, a JSON chunk padded with blanks, a binary chunk, all in multiples of four."""
    blob = painted[2].read_bytes()
    header = np.frombuffer(blob[:20], "<u4")
    assert blob[:4] == b"glTF" and header[1] == 2 and header[2] == len(blob) and header[3] % 4 == 0
    assert blob[16:20] == b"JSON" and blob[24 + header[3] : 28 + header[3]] == b"BIN\0"
    tree = json.loads(blob[20 : 20 + header[3]])
    assert tree["asset"]["version"] == "2.0" and "extensionsRequired" not in tree
    for material in tree["materials"]:
        assert material["doubleSided"] and material["pbrMetallicRoughness"]["metallicFactor"] == 0
    for accessor in tree["accessors"]:
        assert accessor["count"] > 0
    assert all(image["mimeType"] == "image/png" for image in tree["images"])


def test_vertex_colors_over_textures_are_written(tmp_path):
    mesh = load_mesh("primitive:mug", 300)
    colors = rng.uniform(0.1, 0.9, mesh.corner_color_linear.shape).astype(np.float32)
    mesh = replace(mesh, corner_color_linear=colors)
    texture = np.full((2, 2, 3), 200, np.uint8)
    write_glb(mesh, [texture] * len(mesh.materials), tmp_path / "a.glb")
    back = load_mesh(tmp_path / "a.glb", 300, "y")
    ours, read = (np.sort(m.corner_color_linear.reshape(-1)) for m in (mesh, back))
    assert np.abs(ours - read).max() < 0.5 / 255 + 1e-6


def test_a_textured_object_survives_whole(data, tmp_path):
    mesh = load_mesh(data / "meshes" / "gz_stop_light.glb", 300)
    canvas = texture_canvas(mesh, PatchSettings(kind="texture"), tmp_path)
    write_glb(canvas.mesh, canvas.start_srgb, tmp_path / "object.glb")
    back = load_mesh(tmp_path / "object.glb", 300, "y")
    assert np.array_equal(back.materials[0].texture_srgb, canvas.start_srgb[0])
    assert np.allclose(np.sort(back.corner_uv.reshape(-1)), np.sort(mesh.corner_uv.reshape(-1)), atol=1e-6)
    assert np.allclose(np.ptp(back.vertices, axis=0), np.ptp(mesh.vertices, axis=0), rtol=1e-6)


BOTH = """
import hashlib, sys, numpy as np
from patchproof.mesh.load_mesh import write_glb
from patchproof.mesh.load_mesh import load_mesh
from patchproof.mesh.unwrap import unwrap
truck, mug = load_mesh("primitive:box_truck", 300), load_mesh("primitive:mug", 300)
write_glb(truck, [np.full((2, 3, 3), i, np.uint8) for i in range(len(truck.materials))], sys.argv[1])
mug = unwrap(mug, np.ones(len(mug.faces), bool), 128)
print(hashlib.sha256(mug.corner_uv.tobytes() + mug.materials[0].texture_srgb.tobytes()).hexdigest())
"""


def test_written_and_unwrapped_meshes_are_the_same_bytes_in_every_process(tmp_path, monkeypatch, capsys):
    seed = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"  # sets of names come out in another order
    ours, theirs = str(tmp_path / "ours.glb"), str(tmp_path / "theirs.glb")
    command, environment = [sys.executable, "-c", BOTH, theirs], os.environ | {"PYTHONHASHSEED": seed}
    there = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
    monkeypatch.setattr(sys, "argv", ["-c", ours])
    exec(BOTH, {})
    assert capsys.readouterr().out == there and len(there) > 60
    assert (tmp_path / "ours.glb").read_bytes() == (tmp_path / "theirs.glb").read_bytes()
