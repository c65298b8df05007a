"""COCO boxes by hand at a picture's borders; those of photographs stand in `test_given`."""

from __future__ import annotations

import json

import numpy as np

from patchproof.report.coco import PATCH, LabeledPhoto, clip_polygon, coco_json


def annotations(outline, name: str = PATCH) -> list[dict]:
    photo = LabeledPhoto("a.jpg", (100, 80), {name: np.array(outline, float)})
    return json.loads(coco_json([photo], "cup", "test"))["annotations"]


def test_a_polygon_is_cut_off_at_the_borders():
    """A diamond about the corner (0, 0): a quarter of it, the triangle (0, 0), (40, 0), (0, 40), is left."""
    inside = clip_polygon(np.array([[-40.0, 0], [0, -40], [40, 0], [0, 40]]), (100, 80))
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
