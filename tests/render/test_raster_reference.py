"""The rasterizer against the fragments of another one (PyTorch3D), and on real meshes against the slow twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from patchproof.base import geometry
from patchproof.mesh.load_mesh import load_mesh
from patchproof.render.fragments import Cameras
from patchproof.render.raster import rasterize
from test_raster import cameras, picture, slow_twin

INSIDE_PX = 0.01  # both round: nearer to an edge than this they may differ
SHARE = 0.999  # of pixels inside; what is left are faces that meet or nearly coincide in depth
EDGE_SHARE = 0.02  # of the pixels nearer to an edge: the 1/256 pixel grid moves an edge by at most 0.003 px


def the_same_views(theirs) -> Cameras:
    rotation, center = theirs["rotation"].astype(float), theirs["center"].astype(float)
    size = int(theirs["size_px"])
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, -np.einsum("nij,nj->ni", rotation, center)
    matrix = geometry.intrinsics(float(theirs["fov_deg"]), (size, size))
    return Cameras(torch.tensor(poses), torch.tensor(np.stack([matrix] * len(poses))), (size, size))


def corners_at(pixels, face, vertices, faces, views: Cameras) -> np.ndarray:
    """P×3×3 pixel x, y and camera z of the corners of the face at each pixel."""
    width, height = views.size_px
    world = vertices[faces[face]]
    pose = views.camera_from_world.numpy()[pixels // (width * height)]
    camera = np.einsum("pij,pkj->pki", pose[:, :3, :3], world) + pose[:, None, :3, 3]
    image = camera @ views.matrix_px[0].numpy().T
    return np.concatenate([image[..., :2] / image[..., 2:], camera[..., 2:]], -1)


def distance_inside(pixels, corners, width) -> np.ndarray:
    """Pixels from each center to the nearest edge line of its face, negative outside."""
    center = np.stack([pixels % width + 0.5, pixels // width % width + 0.5], 1)
    a, b = corners[..., :2], np.roll(corners[..., :2], -1, 1)
    edge, to = b - a, center[:, None] - a
    signed = (edge[..., 0] * to[..., 1] - edge[..., 1] * to[..., 0]) / np.hypot(edge[..., 0], edge[..., 1]).clip(1e-12)
    turn = np.sign(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0])
    return (signed * turn[:, None]).min(1)


def height_px(corners) -> np.ndarray:
    a, b = corners[..., :2], np.roll(corners[..., :2], -1, 1)
    (u, v), longest = (b - a)[:, :2].transpose(1, 0, 2), np.linalg.norm(b - a, axis=-1).max(1)
    return np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / longest.clip(1e-12)


@pytest.mark.parametrize("name", ["gz_suv", "teapot"])
def test_agrees_with_another_rasterizer(data, name):
    theirs = np.load(data / "reference" / f"{name}.npz")
    views = the_same_views(theirs)
    vertices, faces = theirs["vertices"].astype(float), theirs["faces"].astype(np.int64)
    fragments = rasterize(torch.tensor(vertices), torch.tensor(faces), views, 1e-3 * float(np.ptp(vertices)))
    ours, face = picture(fragments, fragments.face).numpy().reshape(-1), theirs["face"].reshape(-1)
    depth, width = picture(fragments, fragments.depth).numpy().reshape(-1), views.size_px[0]

    pixels = (face >= 0).nonzero()[0]
    inside = np.zeros(len(face), bool)
    inside[pixels] = (
        distance_inside(pixels, corners_at(pixels, face[pixels], vertices, faces, views), width) > INSIDE_PX
    )
    mine = (ours >= 0).nonzero()[0]
    also = distance_inside(mine, corners_at(mine, ours[mine], vertices, faces, views), width) > INSIDE_PX
    inside[mine] |= also
    tie = (ours >= 0) & (face >= 0) & (np.abs(depth - theirs["depth"].reshape(-1)) < 1e-6 * np.abs(depth))
    agree = (ours == face) | tie
    edges = ~inside & ((face >= 0) | (ours >= 0))
    print(
        f"{name}: {(~agree[inside]).sum()} of {inside.sum()} inside, {(~agree[edges]).sum()} of {edges.sum()} at edges"
    )
    assert agree[inside].mean() >= SHARE
    assert (~agree[edges]).mean() <= EDGE_SHARE and 0 < edges.sum() < 0.05 * len(pixels)

    index = (ours[fragments.pixel.numpy()] == face[fragments.pixel.numpy()]).nonzero()[0]
    at = fragments.pixel.numpy()[index]
    np.testing.assert_allclose(depth[at], theirs["depth"].reshape(-1)[at], rtol=1e-4)
    barycentric = fragments.barycentric.numpy()[index]
    corners = corners_at(at, ours[at], vertices, faces, views)
    high = height_px(corners) > 1
    np.testing.assert_allclose(barycentric[high], theirs["barycentric"].reshape(-1, 3)[at][high], atol=1e-3)
    weight = barycentric[..., None] * corners[..., 2:]  # perspective-correct: corners weigh by z
    landed = (weight * corners[..., :2]).sum(1) / weight.sum(1)
    center = np.stack([at % width + 0.5, at // width % width + 0.5], 1)
    assert np.abs(landed - center).max() < 1e-3


@pytest.mark.parametrize("name", ["mug_mujoco", "box_textured", "gz_postbox", "kaykit_trafficlight_A"])
def test_real_meshes_as_the_slow_twin_has_it(data, name):
    """The pixels whose depth no other face ties; where two do to 1e-6, either may win."""
    mesh = load_mesh(data / "meshes" / f"{name}.glb", 480)
    vertices, faces = torch.tensor(mesh.vertices), torch.tensor(mesh.faces)
    views = cameras([[330.0, 150, 420], [-450.0, 300, -200]], (24, 20))
    found, depth = slow_twin(vertices, faces, views)
    fragments = rasterize(vertices, faces, views, 1.0)
    ours = picture(fragments, fragments.face).numpy()
    np.testing.assert_array_equal(ours >= 0, found >= 0)
    np.testing.assert_allclose(picture(fragments, fragments.depth).numpy()[found >= 0], depth[found >= 0], rtol=1e-5)
    assert (ours == found).mean() > 0.97 and (found >= 0).sum() > 50
