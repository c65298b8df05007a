"""The procedural objects: closed, outward, repeatable, and flat where a card is to hang."""

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.mesh import primitives, solids
from patchproof.mesh.load_mesh import load_mesh

ALL_PARTS = [(name, seed) for name in primitives.primitive_names() for seed in range(4)]


def corners_of(part):
    return part.vertices[part.faces]


def welded_edges(part) -> list[tuple[int, int]]:
    points = np.round(part.vertices / np.ptp(part.vertices, axis=0).max(), 7)
    index = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)[part.faces]
    return [(int(f[i]), int(f[(i + 1) % 3])) for f in index for i in range(3)]


def signed_volume(corners) -> float:
    corners = corners - corners.reshape(-1, 3).mean(0)
    return float(np.linalg.det(corners).sum() / 6)


def is_closed(part) -> bool:
    edges = welded_edges(part)
    return len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)


@pytest.mark.parametrize(("name", "seed"), ALL_PARTS)
def test_every_part_is_closed_outward_and_finite(name, seed):
    for part in primitives.parts(name, seed):
        corners = corners_of(part)
        assert np.isfinite(corners).all() and np.isfinite(part.uv).all()
        assert is_closed(part), part.material.name
        assert signed_volume(corners) > 0, part.material.name
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        assert area.min() > 0
        assert -1e-9 <= part.uv.min() and part.uv.max() <= 1 + 1e-9


@pytest.mark.parametrize(("name", "seed"), ALL_PARTS)
def test_corner_normals_are_unit_and_on_the_faces_own_side(name, seed):
    for part in primitives.parts(name, seed):
        corners, normals = corners_of(part), part.normals[part.faces]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-9)
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        face /= np.linalg.norm(face, axis=1, keepdims=True)
        assert (normals * face[:, None]).sum(2).min() > np.cos(np.radians(solids.CREASE_DEG))


def test_the_closedness_check_can_fail():
    part = solids.box((1, 2, 3), (0, 0, 0), "box", (1, 1, 1))
    assert is_closed(part)
    open_part = type(part)(part.vertices, part.faces[1:], part.material)
    assert not is_closed(open_part)
    inside_out = corners_of(part)[:, ::-1]
    assert signed_volume(corners_of(part)) == pytest.approx(6) and signed_volume(inside_out) == pytest.approx(-6)


def test_hand_numbers_of_the_shapes():
    # prism of n sides: area n/2 r² sin(2π/n); lathe of a cylinder is that prism; a cone has a third of its volume
    n, r, h = 24, 2.0, 5.0
    area = n / 2 * r * r * np.sin(2 * np.pi / n)
    cylinder = solids.lathe([(0, 0), (r, 0), (r, h), (0, h)], "c", (1, 1, 1), around=n)
    cone = solids.lathe([(0, 0), (r, 0), (0, h)], "c", (1, 1, 1), around=n)
    tube = solids.tube([(0, 0, 0), (0, 2, 0), (0, h, 0)], r, "t", (1, 1, 1), around=n)
    assert signed_volume(corners_of(cylinder)) == pytest.approx(area * h)
    assert signed_volume(corners_of(cone)) == pytest.approx(area * h / 3)
    assert signed_volume(corners_of(tube)) == pytest.approx(area * h)
    # the outline's direction does not matter
    for outline in ([(0, 0), (2, 0), (2, 1), (0, 1)], [(0, 1), (2, 1), (2, 0), (0, 0)]):
        assert signed_volume(corners_of(solids.prism(outline, -1, 2, "p", (1, 1, 1)))) == pytest.approx(6)


def test_round_sides_are_smooth_and_boxes_are_flat():
    cylinder = solids.lathe([(0, 0), (2, 0), (2, 5), (0, 5)], "c", (1, 1, 1))
    side = np.abs(cylinder.normals[:, 1]) < 0.5
    radial = cylinder.vertices[side] * (1, 0, 1)
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    np.testing.assert_allclose(cylinder.normals[side], radial, atol=1e-9)
    box = solids.box((1, 2, 3), (0, 0, 0), "b", (1, 1, 1))
    assert set(np.round(np.abs(box.normals).max(1), 9)) == {1.0}


def test_a_flat_side_shows_its_texture_upright_once():
    box = solids.box((2, 2, 2), (0, 0, 0), "b", (1, 1, 1))
    right = box.normals[:, 0] > 0.9  # seen from +x, z runs to the left
    at = dict(zip(map(tuple, np.round(box.vertices[right], 6)), map(tuple, np.round(box.uv[right], 6)), strict=True))
    assert at[(1, 2, 1)] == (0, 0) and at[(1, 0, -1)] == (1, 1) and at[(1, 2, -1)] == (1, 0)


@pytest.mark.parametrize("name", primitives.primitive_names())
def test_builds_are_repeatable_varied_and_centered(name):
    first = primitives.build(name, 3)
    primitives.parts.cache_clear()
    again, other = primitives.build(name, 3), primitives.build(name, 4)
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.corner_uv, again.corner_uv)
    assert list(map(vars, first.materials)) == list(map(vars, again.materials))
    assert first.vertices.shape != other.vertices.shape or not np.allclose(first.vertices, other.vertices)
    np.testing.assert_allclose(first.vertices.min(0) + first.vertices.max(0), 0, atol=1e-6)
    assert 80 < np.ptp(first.vertices, axis=0).max() < 9000  # millimeters: from a mug to a truck
    assert len(first.faces) < 4000 and not first.warnings


@pytest.mark.parametrize("name", ["box_truck", "carton", "mailbox", "street_sign"])
@pytest.mark.parametrize("seed", range(3))
def test_some_objects_have_a_flat_side_for_a_card(name, seed):
    mesh = primitives.build(name, seed)
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    facing = normal[:, 0] / (2 * area) > 0.999
    plane = np.round(corners[:, 0, 0], 3)
    flat = max(area[facing & (plane == x)].sum() for x in set(plane[facing]))
    assert np.sqrt(flat) > 0.3 * np.ptp(mesh.vertices, axis=0).max()


def test_names_are_twelve_and_an_unknown_one_is_refused_with_the_nearest():
    assert len(primitives.primitive_names()) == 12 == len(set(primitives.primitive_names()))
    with pytest.raises(Refused, match='"boxtruck": did you mean "box_truck"'):
        primitives.build("boxtruck")


def test_a_scene_names_it_and_gives_the_size():
    mesh = load_mesh("primitive:mug", 100.0, "z")
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(100)
    assert np.ptp(mesh.vertices, axis=0).argmax() in (1, 2)  # it stays upright: the mug's height or its handle's side
