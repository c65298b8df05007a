"""Colors of vertices as the subject: what they show, what a mask over them keeps, what training makes of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from patchlab.paper import transfer
from patchlab.paper.vertex_colors import barycentric, vertex_problem
from patchproof.base.errors import Refused
from patchproof.base.validation import validate_model
from patchproof.mesh.mesh import Material, MeshPart, mesh_from_parts
from patchproof.optimizer.problem import set_problem
from patchproof.scene.scene import load_scene
from test_textures_optimized import scene_file
from test_trained_studies import RED, small, written  # noqa: F401 - small is a fixture


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    """The painted box may change, the box of trim may not."""
    return vertex_problem(set_problem(load_scene(scene_file(tmp_path_factory.mktemp("scene"), "masked"))))


def test_a_texel_mixes_the_corners_of_its_face():
    texture = np.zeros((8, 8, 3), np.uint8)
    corners, uv = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0.0, 0], [1, 0], [0, 1]])
    part = MeshPart(corners, np.array([[0, 1, 2]]), Material("m", (1.0, 1.0, 1.0), texture), uv)
    mask = np.zeros((8, 8), bool)
    mask[1, 2] = mask[7, 7] = True  # within the face, at (2.5, 1.5) of 8, and far beyond its long edge
    vertices, weights = barycentric(mesh_from_parts([part], 100.0), 0, mask)
    assert vertices[0].tolist() == [0, 1, 2] and weights[0] == pytest.approx([0.5, 2.5 / 8, 1.5 / 8])
    assert (weights >= 0).all() and weights.sum(1) == pytest.approx(1)


def test_a_mask_over_vertices_keeps_the_others(masked, tmp_path):
    subject, start = masked.subject, masked.subject.start()
    assert 0 < start.shape[2] == len(subject.vertices) < len(masked.scene.mesh.vertices)
    red = torch.tensor([1.0, 0, 0])[:, None, None]
    before, after = (subject.texels(each)[:, 0] for each in (start, red.expand_as(start)))
    chosen = np.isin(subject._corners.numpy(), subject.vertices)
    assert (after[:, chosen.all(1)] - red[:, 0]).abs().max() < 1e-5  # faces all of whose corners may change
    assert torch.equal(before[:, ~chosen.any(1)], after[:, ~chosen.any(1)])
    subject.save(subject.pixels(start), tmp_path)
    assert subject.clip(start + 2).max() <= 1 and (tmp_path / "object.glb").is_file()


def test_half_way_between_two_corners_lies_the_mean_of_their_colors(masked):
    subject = masked.subject
    design = torch.zeros(3, 1, len(subject.vertices))
    design[:, 0, 0] = 1.0  # one vertex is white
    texels, weights = subject.texels(design)[0, 0], subject._weights.numpy()
    share = (weights * (subject._corners.numpy() == subject.vertices[0])).sum(1)
    chosen = np.isin(subject._corners.numpy(), subject.vertices).all(1)
    assert texels.numpy()[chosen] == pytest.approx(share[chosen], abs=1e-5) and 0 < (share > 0.5).sum()


def test_an_image_over_uv_is_no_mask_over_vertices(tmp_path):
    from PIL import Image

    Image.new("L", (8, 8), 255).save(tmp_path / "half.png")
    problem = set_problem(load_scene(scene_file(tmp_path, "image")))
    with pytest.raises(Refused, match=r'mask = "half\.png": name patch\.faces'):
        vertex_problem(problem)


def test_trained_colors_of_vertices_are_what_the_network_asks_for(tmp_path):
    ways = {"v": {"optimize": {"optimizer": "sign", "step_size": 0.2}}}
    common = {"scenes": ("texture.toml",), "networks": (RED,), "n": 4, "lights": 1, "ways": ways}
    base = written(tmp_path).parent
    settings = transfer.TransferSettings(**common, vertex_colors=("v",), ensembles=False)
    original, trained = (transfer.run(settings, base, cell) for cell in transfer.cells(settings, base))
    assert trained["hits"]["design"] == ["1111"] and "0" in original["hits"]["design"][0]
    with pytest.raises(Refused, match="vertex_colors among ways"):
        validate_model(transfer.TransferSettings, {**common, "vertex_colors": ("w",)}, "study.toml")
