"""Unwrapping: a place of its own for every face, the look kept, the same bytes twice."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.settings import PatchSettings
from patchproof.mesh import unwrap as unwrapping
from patchproof.mesh.load_mesh import load_mesh
from patchproof.mesh.mesh import Material, MeshPart, mesh_from_parts
from patchproof.mesh.unwrap import coverage, has_usable_uv, unwrap
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.scene.scene import make_scene
from patchproof.scene.texture_scene import texture_canvas

SOUP = np.random.default_rng(0).normal(size=(90, 3))


def soup():
    return mesh_from_parts([MeshPart(SOUP, np.arange(90).reshape(-1, 3), Material("m", (0.5, 0.5, 0.5)))], 300)


def mesh_of(name, data=None):
    return soup() if name == "soup" else load_mesh(name if ":" in name else data / "meshes" / name, 300)


def atlas(mesh, texels=512):
    """(corners in texels F×3×2, size) of a mesh unwrapped whole."""
    done = unwrap(mesh, np.ones(len(mesh.faces), bool), texels)
    (material,) = done.materials
    size = material.texture_srgb.shape[1::-1]
    return done.corner_uv.astype(float) * size, size


def areas(corners):
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    if corners.shape[-1] == 2:
        return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return np.linalg.norm(np.cross(a, b), axis=1) / 2


def charts(corners):
    """The chart of each face: faces that share a corner in the atlas."""
    point = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)[1].reshape(-1, 3)
    pairs = np.concatenate([point[:, :2], point[:, 1:]])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(point.max() + 1,) * 2)
    return connected_components(graph, directed=False)[1][point[:, 0]]


@pytest.mark.parametrize("name", ["teapot.glb", "gz_suv.glb", "kaykit_trafficlight_A.glb", "primitive:carton", "soup"])
def test_every_face_has_a_place_of_its_own(data, name):
    mesh = mesh_of(name, data)
    corners, size = atlas(mesh)
    assert areas(corners).min() > 0 and corners.min() > 0 and (corners.max((0, 1)) < size).all()
    assert coverage(corners, size).max() == 1
    chart = charts(corners)
    rims = sum((coverage(corners[chart == i], size, 1.5) > 0).astype(int) for i in np.unique(chart))
    assert rims.max() == 1  # gutters do not meet either, not even round the texture's border
    assert 0.4 < areas(corners).sum() / 512**2 < 1.6  # about as many texels as were asked for
    density = areas(corners) / areas(mesh.vertices[mesh.faces])
    order = np.argsort(density)
    share = np.cumsum(areas(mesh.vertices[mesh.faces])[order])
    low, middle, high = density[order][np.searchsorted(share / share[-1], [0.01, 0.5, 0.99])]
    assert middle / low < 1.5 and high / middle < 1.5  # measured: 0.74 and 1.44 on the traffic light


def test_a_finely_divided_sphere_comes_apart_evenly():
    """xatlas by itself crashes here: neighbors so nearly coplanar that it makes one chart of the whole sphere."""
    sphere = trimesh.creation.icosphere(6)
    mesh = mesh_from_parts([MeshPart(sphere.vertices, sphere.faces, Material("m", (0.5, 0.5, 0.5)))], 300)
    corners, size = atlas(mesh, 256)
    assert len(corners) == 81920 and coverage(corners, size).max() == 1
    density = areas(corners) / areas(mesh.vertices[mesh.faces])
    low, middle, high = np.quantile(density, [0.01, 0.5, 0.99])
    assert middle / low < 1.6 and high / middle < 1.6


def test_faces_that_xatlas_folds_over_others_are_cut_out(monkeypatch):
    packed, calls = unwrapping._pack, []

    def folded_once(points, faces, part, texels):
        uv, size = packed(points, faces, part, texels)
        calls.append(part.copy())
        if len(calls) == 1:
            uv[7] = uv[3]
        return uv, size

    monkeypatch.setattr(unwrapping, "_pack", folded_once)
    corners, size = atlas(soup(), 256)
    assert coverage(corners, size).max() == 1 and list(np.flatnonzero(calls[1])) == [3, 7]


def test_a_vertex_texture_keeps_its_colors():
    """Colors that vary linearly over a face, read back at random points of it by a bilinear look-up."""
    mesh = load_mesh("primitive:mug", 300)
    low, extent = mesh.vertices.min(0), np.ptp(mesh.vertices, axis=0)
    colors = ((mesh.vertices - low) / extent)[mesh.faces].astype(np.float32)
    material = Material("m", (1.0, 0.5, 1.0))
    mesh = replace(mesh, materials=(material,), face_material=0 * mesh.face_material, corner_color_linear=colors)
    canvas = texture_canvas(mesh, PatchSettings(kind="texture"), Path("."), 512)
    assert "648 of 648" in canvas.warnings[0] and canvas.names == ("m",)
    assert (canvas.mesh.corner_color_linear == 1).all() and np.array_equal(canvas.mesh.faces, mesh.faces)
    weights = np.random.default_rng(1).dirichlet([1] * 3, (len(mesh.faces), 20))
    expected = np.einsum("fnk,fkc->fnc", weights, colors * [1.0, 0.5, 1.0]).reshape(-1, 3)
    uv = np.einsum("fnk,fkc->fnc", weights, canvas.mesh.corner_uv.astype(float)).reshape(-1, 2)
    seen = bilinear(linear_from_srgb(canvas.start_srgb[0] / 255), uv)
    # a code is at most 0.009 of light, at white; at rims, colors go on constantly instead of linearly
    assert np.abs(seen - expected).max() < 0.03 and np.abs(seen - expected).mean() < 0.003


def bilinear(texture, uv):
    x, y = (uv * texture.shape[1::-1] - 0.5).T
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = texture[y0, x0] * (1 - fx) + texture[y0, x0 + 1] * fx
    return top * (1 - fy) + (texture[y0 + 1, x0] * (1 - fx) + texture[y0 + 1, x0 + 1] * fx) * fy


def test_texels_between_charts_take_the_nearest_color():
    mesh = soup()
    done = unwrap(mesh, np.ones(30, bool), 64)
    assert len(np.unique(done.materials[0].texture_srgb)) == 1


def test_only_faces_without_coordinates_are_unwrapped():
    paint = np.random.default_rng(2).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    near = SOUP[:, :2] - SOUP[:, :2].min() + 0.1
    parts = [
        MeshPart(SOUP, np.arange(90).reshape(-1, 3), Material("painted", (1, 1, 1), paint), near),
        MeshPart(SOUP + 9, np.arange(90).reshape(-1, 3), Material("bare", (0.25, 0.5, 0.0))),
        MeshPart(SOUP + 18, np.arange(30).reshape(-1, 3), Material("absurd", (1, 1, 1), paint), near * 1e9),
    ]
    mesh = mesh_from_parts(parts, 300)
    assert np.array_equal(has_usable_uv(mesh), np.arange(70) < 30)
    assert not has_usable_uv(replace(mesh, corner_uv=mesh.corner_uv * np.float32("nan"))).any()
    canvas = texture_canvas(mesh, PatchSettings(kind="texture"), Path("."), 64)
    assert canvas.names == ("painted", "unwrapped") and "40 of 70" in canvas.warnings[0]
    assert np.array_equal(canvas.mesh.corner_uv[:30], mesh.corner_uv[:30])
    assert np.array_equal(canvas.start_srgb[0], paint)
    one = texture_canvas(mesh, PatchSettings(kind="masked", materials=("bare",)), Path("."), 64)
    assert one.names == ("painted", "absurd", "bare") and [mask.any() for mask in one.mask] == [False, False, True]


@pytest.mark.parametrize(
    "thin",
    [
        [[0, 0, 0], [1000, 0, 0], [1000, 1e-3, 0]],  # a needle
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1e-9, 0, 0], [0, 1e-9, 0]],  # a speck beside a face
    ],
)
def test_needles_and_specks_do_not_blow_up_the_atlas(thin):
    mesh = mesh_from_parts(
        [MeshPart(np.array(thin, float), np.arange(len(thin)).reshape(-1, 3), Material("m", (1, 1, 1)))], 300
    )
    canvas = texture_canvas(mesh, PatchSettings(kind="texture"), Path("."), 128)
    assert max(canvas.start_srgb[0].shape) < 4 * 128 and (canvas.start_srgb[0] == 255).all()
    assert np.isfinite(canvas.mesh.corner_uv).all()


def test_without_xatlas_textures_of_such_meshes_are_refused_and_all_else_works(monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    box = trimesh.creation.box((3, 2, 2))  # without texture coordinates
    settings = {
        "object": {"mesh": "python:box", "length_mm": 300},
        "patch": {"width_mm": 90, "height_mm": 90},
        "target": {"label": "carton", "models": ["builtin"]},
        "camera": {"photo_px": [64, 64]},
    }
    scene = make_scene(settings, box)
    assert photograph(set_stage(scene), None, scene.draw("train", 1), (64, 64)).std() > 0.01
    with pytest.raises(Refused, match=r'the package xatlas.*got no such package: pip install "patchproof\[textures\]"'):
        make_scene(settings | {"patch": {"kind": "texture"}}, box)
    mug = settings["object"] | {"mesh": "primitive:mug"}  # which has texture coordinates
    warnings = make_scene(settings | {"object": mug, "patch": {"kind": "texture"}}).canvas.warnings
    assert not any("unwrapped" in warning for warning in warnings)
