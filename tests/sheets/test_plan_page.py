"""The page that says where the piece goes: millimeters to named edges, known by hand."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from conftest import SCENE

from patchproof.base.errors import Refused
from patchproof.base.settings import load_scene_settings
from patchproof.reprints.run_sheet import draw_plan_view, shot_sections
from patchproof.sheets.plan_page import PlacementPicture, PlanPage, edge_distances_mm, lay_out_plan, wrap_text
from patchproof.sheets.template import load_template
from test_benefit_shown import promise_with
from test_scene import scene_of

A4 = load_template("a4")
OUTLINE = ((-20.0, -45.0), (60.0, -45.0), (60.0, 15.0), (-20.0, 15.0))
HUNG = PlacementPicture(np.full((60, 100, 3), 200, np.uint8), (-110, -66, 220, 132), (-100, -60, 200, 120), OUTLINE)


def boxed(tmp_path, **patch):
    """A box of 400 × 240 × 160 mm (x, y, z) with a patch of 60 × 40 mm on its +z side."""
    trimesh.creation.box((200, 120, 80)).export(tmp_path / "box.ply")
    lines = "\n".join(f"{key} = {value}" for key, value in patch.items())
    text = SCENE.replace("primitive:carton", "box.ply").replace("length_mm = 300", "length_mm = 400")
    text = text.replace("height_mm = 90", f"height_mm = 40\n{lines}").replace("width_mm = 90", "width_mm = 60")
    return scene_of(tmp_path, text.replace("[500, 900]", "[600, 900]"))


@pytest.mark.parametrize("spin", [0, 90])
def test_edges_of_a_piece_on_a_box(tmp_path, spin):
    scene = boxed(tmp_path, offset_mm="[30, 20]", spin_deg=spin)
    width, height = scene.piece.size_mm if spin == 0 else scene.piece.size_mm[::-1]
    found = draw_plan_view(scene, A4)
    # the side is 400 × 240: its middle lies 200 and 120 from the edges, the piece's 30 right of it and 20 up
    assert edge_distances_mm(found) == pytest.approx(
        {
            "left": 230 - width / 2,
            "right": 170 - width / 2,
            "top": 100 - height / 2,
            "bottom": 140 - height / 2,
        },
        abs=0.02,
    )
    # another reader: the picture's own pixels that are not white end where the object does
    across, down = ((found.picture < 250).any(2).any(axis) for axis in (0, 1))
    px_per_mm = found.picture.shape[1] / found.picture_mm[2]
    for row, start, low, length in ((across, *found.picture_mm[:1], -200, 400), (down, found.picture_mm[1], -120, 240)):
        inked = np.flatnonzero(row)
        assert inked[0] / px_per_mm + start == pytest.approx(low, rel=0.01, abs=1 / px_per_mm)
        assert (inked[-1] + 1 - inked[0]) / px_per_mm == pytest.approx(length, rel=0.01, abs=1 / px_per_mm)


def test_a_long_thin_side_has_a_plan_of_few_pixels(tmp_path):
    trimesh.creation.box((1000, 50, 50)).export(tmp_path / "bar.ply")
    text = SCENE.replace("primitive:carton", "bar.ply").replace("length_mm = 300", "length_mm = 1000")
    text = text.replace("= 90", "= 45").replace("[500, 900]", "[600, 900]")
    assert draw_plan_view(scene_of(tmp_path, text), A4).picture.shape == (30, 600, 3)


def test_edges_of_a_real_mesh_add_up_to_what_another_reader_measures(tmp_path, data):
    path = data / "meshes" / "gz_suv.glb"
    extents = trimesh.load(path, force="mesh").extents
    text = SCENE.replace("primitive:carton", str(path)).replace("length_mm = 300", "length_mm = 480")
    found = draw_plan_view(scene_of(tmp_path, text.replace('"+z"', '"+x"').replace("[500, 900]", "[700, 900]")), A4)
    edges, (xs, ys) = edge_distances_mm(found), zip(*found.outline_mm, strict=True)
    scaled = sorted(extents * 480 / extents.max())
    wide, high = (edges["left"] + edges["right"] + np.ptp(xs), edges["top"] + edges["bottom"] + np.ptp(ys))
    assert min(abs(side - wide) for side in scaled) < 0.5 and min(abs(side - high) for side in scaled) < 0.5


def test_chains_run_from_edge_to_edge_at_the_picture_s_scale():
    assert edge_distances_mm(HUNG) == {"left": 80, "right": 40, "top": 15, "bottom": 45}
    page = lay_out_plan(PlanPage(HUNG, (("Where the piece goes", ("Here.",)),)), A4, "A1B2C3D4E5")
    words = [line.text for line in page.layout.texts]
    for word in ("80 mm from left edge", "80 mm piece", "40 mm from right edge", "15 mm", "60 mm", "45 mm"):
        assert word in words
    ((x, y, w, h), _) = page.pictures[0]
    assert w / h == pytest.approx(220 / 132)
    row = sorted({t.ends_mm[i] for t in page.layout.ticks if t.ends_mm[1] == t.ends_mm[3] == y - 2.0 for i in (0, 2)})
    assert [b - a for a, b in pairwise(row)] == pytest.approx([80 * w / 220, 80 * w / 220, 40 * w / 220])
    column = [t for t in page.layout.ticks if t.ends_mm[0] == t.ends_mm[2] == x + w + 2.0]
    assert sorted(t.ends_mm[3] - t.ends_mm[1] for t in column) == pytest.approx([v * h / 132 for v in (15, 45, 60)])


def test_words_that_do_not_fit_the_page_are_refused():
    lay_out_plan(PlanPage(None, (("A", ("word " * 100,)),)), A4, "A1B2C3D4E5")
    with pytest.raises(Refused, match="within the margins"):
        lay_out_plan(PlanPage(None, (("A", ("word " * 9000,)),)), A4, "A1B2C3D4E5")
    assert wrap_text("one two three", 2.6, 8.0) == ["one", "two", "three"]


def test_bent_paper_on_a_can_is_drawn_as_one_sees_it(tmp_path):
    can = trimesh.creation.cylinder(50, 200, sections=256)
    can.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    can.export(tmp_path / "object.ply")
    text = (
        SCENE.replace("primitive:carton", "object.ply")
        .replace("= 300", "= 200")
        .replace("width_mm = 90", "width_mm = 70")
    )
    text = text.replace("height_mm = 90", "height_mm = 60\nbend = true\noffset_mm = [0, 20]")
    found = edge_distances_mm(draw_plan_view(scene_of(tmp_path, text), A4))
    # the can's middle is 100 mm from rim and ground, the piece's 20 mm higher; it reaches 35 mm round a radius of 50
    assert (found["top"], found["bottom"]) == (pytest.approx(50, abs=0.3), pytest.approx(90, abs=0.3))
    assert (found["left"], found["right"]) == (pytest.approx(50 - 50 * np.sin(0.7), abs=0.3),) * 2


@pytest.mark.parametrize(
    ("draft", "start"),
    [(False, "helps: +50.0 points ["), (True, "Draft of 400 views (preliminary): helps: +50.0 points [")],
)
def test_the_first_line_is_a_sentence_of_what_the_design_is_worth(scene_file, draft, start):
    promise = promise_with(0.9, 0.4, 0.42, 0.57).changed(draft=draft)
    first = shot_sections(promise, load_scene_settings(scene_file))[0][1][0]
    assert first.startswith(start) and "] beside its best control (bare) in the same 400 views" in first
    assert ". Promise simulated before ONE PLAIN COLOR" in first and first.endswith(".") and ".." not in first


def test_a_promise_that_stopped_early_says_that_a_full_one_may_save_photographs(scene_file):
    promise, settings = promise_with(0.9, 0.4, 0.42, 0.57), load_scene_settings(scene_file)
    stopped = promise.changed(n=200, conditions=promise.conditions[:200])
    said = [" ".join(shot_sections(each, settings)[0][1]) for each in (promise, stopped, stopped.changed(draft=True))]
    assert ["patchproof promise RUN --n 400, then this page again" in each for each in said] == [False, True, False]
