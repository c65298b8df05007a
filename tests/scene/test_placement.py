"""Where the card lies: sides, spin, gap, overhang, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.settings import PatchSettings
from patchproof.mesh.load_mesh import load_mesh
from patchproof.scene.placement import LIFT_MM, patch_frame, place_card


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """200 × 120 × 80 mm (x, y, z)."""
    import trimesh

    path = tmp_path_factory.mktemp("mesh") / "box.ply"
    trimesh.creation.box((200, 120, 80)).export(path)
    return load_mesh(path, 200, "y")


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    import trimesh

    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    trimesh.creation.icosphere(subdivisions=5, radius=100).export(path)
    return load_mesh(path, 200, "y")


def card_on(mesh, size=(50, 40), **patch):
    settings = PatchSettings(width_mm=size[0], height_mm=size[1], **patch)
    return place_card(mesh, patch_frame(mesh, settings), size, settings.spin_deg)


@pytest.mark.parametrize(
    ("side", "middle"),
    [
        ("+x", (100, 0, 0)),
        ("-x", (-100, 0, 0)),
        ("+y", (0, 60, 0)),
        ("-y", (0, -60, 0)),
        ("+z", (0, 0, 40)),
        ("-z", (0, 0, -40)),
    ],
)
def test_a_card_lies_on_its_side_facing_out(box, side, middle):
    card = card_on(box, side=side)
    middle = np.array(middle, float)
    np.testing.assert_allclose(card.center_mm, middle + LIFT_MM * np.sign(middle), atol=1e-9)
    np.testing.assert_allclose(card.normal, np.sign(middle), atol=1e-12)
    assert card.gap_mm == pytest.approx(0, abs=1e-9) and card.overhang_share == 0
    rotation = card.world_from_piece[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_offset_is_right_and_up_as_one_faces_the_side(box):
    """Facing +x from outside with y up, the right hand points to -z."""
    card = card_on(box, side="+x", offset_mm=(10, 20), size=(30, 30))
    np.testing.assert_allclose(card.center_mm[1:], [20, -10], atol=1e-9)
    np.testing.assert_allclose(card.world(np.array([[30.0, 15]]))[0][2], -25, atol=1e-9)  # the piece's right edge


def test_spin_turns_clockwise_as_one_faces_the_card(box):
    card = card_on(box, side="+z", spin_deg=90, size=(40, 20))
    top = card.world(np.array([[20.0, 0.0]]))[0] - card.center_mm
    np.testing.assert_allclose(top, [10, 0, 0], atol=1e-9)  # what was up points right


def test_lengths_on_the_card_are_millimeters_of_the_sheet(box):
    card = card_on(box, side="+z", spin_deg=33)
    corners = card.world(np.array([[0, 0], [50, 0], [50, 40], [0, 40.0]]))
    np.testing.assert_allclose(np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1), [50, 40, 50, 40])


def test_a_card_is_two_triangles_that_face_out(box):
    card = card_on(box, side="+x", spin_deg=20)
    assert card.is_flat
    np.testing.assert_allclose(card.world(card.piece_mm), card.vertices_mm, atol=1e-12)
    a, b, c = card.vertices_mm[card.faces].transpose(1, 0, 2)
    facing = np.cross(b - a, c - a) / (50 * 40)  # each triangle is half of the card
    np.testing.assert_allclose(facing, [[1, 0, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose(card.normals, [[1, 0, 0]] * 4, atol=1e-12)


def test_gap_on_a_ball_is_its_sagitta(ball):
    """A 60 × 60 card touches the pole; at its corners the ball is r - sqrt(r² - 2·30²) lower."""
    card = card_on(ball, side="+y", size=(60, 60))
    assert card.gap_mm == pytest.approx(100 - np.sqrt(100**2 - 2 * 30**2), rel=0.02)
    assert card.overhang_share == 0


def test_overhang_is_measured_and_warned_about(box):
    card = card_on(box, side="+z", offset_mm=(85, 0), size=(50, 40))
    assert card.overhang_share == pytest.approx(0.2, abs=0.02)  # 10 of 50 mm
    assert any("overhang" in warning for warning in card.warnings)


def test_a_point_in_the_scene_takes_the_nearest_surface(box):
    card = card_on(box, at_mm=(20, 10, 90))
    np.testing.assert_allclose(card.center_mm, [20, 10, 40 + LIFT_MM], atol=1e-6)
    np.testing.assert_allclose(card.normal, [0, 0, 1], atol=1e-9)


def test_the_largest_card_fits_and_a_larger_one_is_refused(box):
    assert card_on(box, side="+x", size=(80, 120)).overhang_share < 0.01
    with pytest.raises(Refused, match=r"no larger than the object's side \(80 × 120 mm\), got 90 × 120"):
        card_on(box, side="+x", size=(90, 120))
    with pytest.raises(Refused, match="no larger"):
        card_on(box, side="+x", size=(80, 120), spin_deg=45)


def test_a_card_beside_the_object_is_refused(box):
    with pytest.raises(Refused, match="no surface under it"):
        card_on(box, side="+x", offset_mm=(200, 0))
