"""Boxes that somebody drew round the object: read from COCO JSON, and used in place of what the sheet tells."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import patchproof as pp
from patchproof.base.errors import Refused
from patchproof.classifier.detector import iou
from patchproof.evidence.boxes import box_in_square, box_of_photo, load_boxes


def coco(path, *boxes, categories=("truck", "patch"), images=("a/p1.jpg", "b/p2.jpg", "b/p1.jpg")):
    """`boxes` are (image, category, bbox) by number from 1."""
    data = {
        "images": [{"id": i, "file_name": name, "width": 40, "height": 30} for i, name in enumerate(images, 1)],
        "categories": [{"id": i, "name": name} for i, name in enumerate(categories, 1)],
        "annotations": [{"id": n, "image_id": i, "category_id": c, "bbox": b} for n, (i, c, b) in enumerate(boxes)],
    }
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def test_boxes_are_found_by_name_or_by_a_last_part_that_is_alone(tmp_path):
    one, two, three = [1, 2, 10, 20], [3, 4, 5, 6], [0, 0, 9, 9]
    path = coco(tmp_path / "c.json", (1, 1, one), (1, 2, [0, 0, 1, 1]), (2, 1, two), (3, 1, three))
    boxes = load_boxes(path, "truck")
    assert box_of_photo(boxes, "a/p1.jpg") == (1, 2, 11, 22) and box_of_photo(boxes, "b/p1.jpg") == (0, 0, 9, 9)
    assert box_of_photo(boxes, "p2.jpg") == box_of_photo(boxes, "elsewhere/p2.jpg") == (3, 4, 8, 10)
    assert box_of_photo(boxes, "p1.jpg") is None, "two photographs are called so"
    only = coco(tmp_path / "d.json", (1, 1, one), categories=("thing",))
    assert load_boxes(only, "truck") == {"a/p1.jpg": (1, 2, 11, 22), "p1.jpg": (1, 2, 11, 22)}


def test_shares_are_of_the_centered_square():
    assert box_in_square((10, 0, 30, 30), (40, 30)) == pytest.approx((5 / 30, 0, 25 / 30, 1))
    assert box_in_square((0, 5, 20, 20), (40, 30)) == pytest.approx((0, 5 / 30, 0.5, 20 / 30)), "cut off at its border"
    assert box_in_square((0, 5, 5, 20), (40, 30)) == (0, 0, 0, 0), "outside, which nothing that is found overlaps"


@pytest.mark.parametrize(
    ("boxes", "categories", "message"),
    [
        (((1, 1, [1, 2, 3, 4]), (1, 1, [2, 2, 3, 4])), ("truck", "patch"), "2 in a/p1.jpg"),
        (((9, 1, [1, 2, 3, 4]),), ("truck", "patch"), "unknown image 9"),
        (((1, 1, [1, 2, 0, 4]),), ("truck", "patch"), "bbox"),
        (((1, 1, [1, 2, 3, 4]),), ("lorry", "patch"), 'a category "truck"'),
    ],
)
def test_what_is_not_one_box_a_photograph_is_refused(tmp_path, boxes, categories, message):
    with pytest.raises(Refused, match=message):
        load_boxes(coco(tmp_path / "c.json", *boxes, categories=categories), "truck")


@pytest.fixture(scope="module")
def journey(tmp_path_factory):
    """A run before the shipped detector, its sheet, and photographs of the design and of the bare truck."""
    folder = tmp_path_factory.mktemp("boxes")
    scene = pp.make_scene(
        {
            "object": {"mesh": "primitive:box_truck", "length_mm": 400},
            "patch": {"width_mm": 120, "height_mm": 120, "side": "+x"},
            "target": {"label": "box truck", "models": ["builtin-detector"], "least_score": 0.3},
            "background": {"color": [0.5, 0.5, 0.5]},
            "camera": {"photo_px": [640, 480]},
            "optimize": {"steps": 1, "views": 1},
        }
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 2)
        run = pp.optimize(scene, folder / "run", promise=pp.PromiseOptions(8, ("bare",)))
    pp.sheet(run, folder / "sheet.pdf")
    pp.reprint(folder / "sheet.pdf", run, 3, folder / "photos")
    bare = folder / "controls" / "bare"
    bare.mkdir(parents=True)
    pixels = pp.photograph(pp.set_stage(scene), None, scene.draw("reprint", 3), (640, 480))
    for number, picture in enumerate(pixels.permute(0, 2, 3, 1).numpy(), 1):
        Image.fromarray((picture * 255).round().astype(np.uint8)).save(bare / f"photo_{number:04d}.jpg", quality=95)
    return SimpleNamespace(folder=folder, sheet=folder / "sheet.json", photos=folder / "photos")


def verified(journey, name, **options):
    return pp.verify(journey.photos, journey.sheet, journey.folder / name, ledger_photos=0, **options)


def answers(report):
    return [photo.predictions["builtin-detector"].target_confidence for photo in report.photos]


def test_drawn_boxes_judge_as_the_sheet_s_own_do_which_are_where_the_object_is(journey):
    alone = verified(journey, "alone")
    drawn = verified(
        journey, "drawn", capture=pp.CaptureInfo(boxes=journey.photos / "coco.json")
    )  # the truth, as `reprint` wrote it
    assert answers(drawn) == pytest.approx(answers(alone), abs=0.02) and drawn.origin.options["boxes"] == "coco.json"
    told, true = (load_boxes(f / "coco.json", "box truck") for f in (journey.folder / "alone", journey.photos))
    sizes = {image["file_name"]: image for image in json.loads((journey.photos / "coco.json").read_text())["images"]}
    assert len(told) == len(true) == 3
    for name, box in true.items():
        width, height = sizes[name]["width"], sizes[name]["height"]
        margin = (max(width, height) - min(width, height)) / 2
        x, y = (margin, 0) if width > height else (0, margin)  # a report knows what lies in the middle square
        inside = np.clip(box, (x, y, x, y), (width - x, height - y, width - x, height - y))
        assert iou(torch.tensor(told[name])[None, None], torch.tensor(inside)[None]) > 0.95, name


def test_boxes_elsewhere_take_the_object_away_from_design_and_bare_photographs_even_when_a_run_goes_on(journey):
    names = [path.name for path in sorted(journey.photos.glob("*.jpg"))]
    names += [f"bare/{name}" for name in names]
    corner = [(number, 1, [2 + 80 * (number % 2), 2, 12, 12]) for number in range(1, 7)]  # in and out of the square
    wrong = coco(journey.folder / "w.json", *corner, categories=("box truck",), images=names)
    options = {"controls": journey.folder / "controls"}
    (bare,) = verified(journey, "wrong", **options).controls
    assert bare.recognized == 3, "without a box whatever is found counts"
    report = verified(journey, "wrong", **options, capture=pp.CaptureInfo(boxes=wrong), resume=True)
    assert max(answers(report)) < 0.3 and report.controls[0].recognized == 0


def test_boxes_of_other_photographs_are_refused(journey):
    other = coco(journey.folder / "o.json", (1, 1, [1, 2, 3, 4]), categories=("box truck",), images=("x.jpg",))
    with pytest.raises(Refused, match="boxes of these photographs"):
        verified(journey, "other", capture=pp.CaptureInfo(boxes=other))
