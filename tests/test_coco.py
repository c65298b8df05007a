"""COCO boxes: by hand at a picture's borders, and an object's box against its rendered pixels."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.report.coco import PATCH, Labeled, coco_json, cut_off
from patchproof.scene.scene import needs_mesh
from test_api import scene
from test_optimize import scene_with


def annotations(outline, name: str = PATCH) -> list[dict]:
    photo = Labeled("a.jpg", (100, 80), {name: np.array(outline, float)})
    return json.loads(coco_json([photo], "cup", "test"))["annotations"]


def test_a_polygon_is_cut_off_at_the_borders():
    """A diamond about the corner (0, 0): a quarter of it, the triangle (0, 0), (40, 0), (0, 40), is left."""
    inside = cut_off(np.array([[-40.0, 0], [0, -40], [40, 0], [0, 40]]), (100, 80))
    assert {tuple(point) for point in inside.tolist()} == {(0, 0), (40, 0), (0, 40)}
    (found,) = annotations([[-40, 0], [0, -40], [40, 0], [0, 40]])
    assert found["bbox"] == [0, 0, 40, 40] and found["area"] == 800 and found["iscrowd"] == 0


def test_what_is_whole_stays_and_what_is_outside_goes():
    square = [[10, 10], [30, 10], [30, 40], [10, 40]]
    (found,) = annotations(square)
    assert found["bbox"] == [10, 10, 20, 30] and found["segmentation"] == [[10, 10, 30, 10, 30, 40, 10, 40]]
    (found,) = annotations(square, "cup")
    assert found["area"] == 600 and "segmentation" not in found and found["category_id"] == 1
    assert annotations([[110, 10], [130, 10], [130, 40]]) == [] == annotations([[10, 10], [np.nan, 10], [30, 40]])
    assert annotations([[99.5, 10], [130, 10], [130, 40], [99.5, 40]]) == []  # half a pixel of it shows


def test_an_objects_box_is_that_of_its_pixels():
    """A box before two backgrounds: what does not change is the object. A wall would be thinner than a pixel."""
    camera = {"photo_px": [320, 240], "blur_px": [0, 0], "noise": [0, 0]}
    scenes = [scene(camera=camera, background={"color": [value] * 3}) for value in (0, 1)]
    conditions = scenes[0].draw("evaluate", 3)
    dark, light = (photograph(set_stage(s), None, conditions, (320, 240), jpeg=False).numpy() for s in scenes)
    for i in range(3):
        rows, columns = np.nonzero(np.abs(dark[i] - light[i]).max(0) < 0.5)
        hull = cut_off(needs_mesh(scenes[0]).object_px(conditions[i : i + 1]), (320, 240))
        assert [columns.min(), rows.min()] == pytest.approx(hull.min(0).tolist(), abs=1)
        assert [columns.max() + 1, rows.max() + 1] == pytest.approx(hull.max(0).tolist(), abs=1)


def test_an_object_partly_behind_the_camera_has_no_box(tmp_path, monkeypatch):
    carton = scene_with(tmp_path)
    drawn = carton.draw("evaluate", 1)
    poses = carton.camera_from_world(drawn)
    monkeypatch.setattr(type(carton), "camera_from_world", lambda self, conditions: poses)
    large = replace(carton, mesh=replace(carton.mesh, vertices=100 * carton.mesh.vertices))
    assert np.isfinite(carton.object_px(drawn)).all() and np.isnan(large.object_px(drawn)).all()
