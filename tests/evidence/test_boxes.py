"""Boxes that somebody drew round the object: read from COCO JSON, and used in place of what the sheet tells."""

from __future__ import annotations

import json
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import patchproof as pp
from patchproof.base.declarations import load_declarations
from patchproof.base.errors import Refused
from patchproof.classifier.detector import iou
from patchproof.evidence.annotations import box_of_photo, find_in_photos, load_boxes, load_corners
from patchproof.evidence.classify import box_in_square

BOXES_DECLARED = [
    entry for entry in load_declarations("evidence") if entry.file == "COCO JSON"
]  # corners: see test_corners


def coco(
    path, *boxes, categories=("truck", "patch"), images=("a/p1.jpg", "b/p2.jpg", "b/p1.jpg"), size=(40, 30), **more
):
    """`boxes` are (image, category, bbox) by number from 1; `more` is declared of each."""
    data = {
        "images": [{"id": i, "file_name": n, "width": size[0], "height": size[1]} for i, n in enumerate(images, 1)],
        "categories": [{"id": i, "name": name} for i, name in enumerate(categories, 1)],
        "annotations": [
            {"id": n, "image_id": i, "category_id": c, "bbox": b} | more for n, (i, c, b) in enumerate(boxes)
        ],
    }
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def test_boxes_are_found_by_names_that_end_alike(tmp_path):
    one, two, three = [1, 2, 10, 20], [3, 4, 5, 6], [0, 0, 9, 9]
    path = coco(tmp_path / "c.json", (1, 1, one), (1, 2, [0, 0, 1, 1]), (2, 1, two), (3, 1, three))
    boxes, photo = load_boxes(path, "truck"), tmp_path / "p.png"
    Image.new("RGB", (40, 30)).save(photo)

    def find(*names):
        return find_in_photos("boxes", boxes, box_of_photo, [(name, photo) for name in names])[0]

    *found, elsewhere = find("x/a/p1.jpg", "b/p1.jpg", "p2.jpg", "elsewhere/p2.jpg")
    want = [(1, 2, 11, 22), (0, 0, 9, 9), (3, 4, 8, 10)]
    assert found == [pytest.approx(tuple(np.divide(box, (40, 30, 40, 30)))) for box in want] and elsewhere is None
    _, remaining = find_in_photos("boxes", boxes, box_of_photo, [("b/p2.jpg", photo)])
    assert sorted(remaining) == ["a/p1.jpg", "b/p1.jpg"]
    for names, match in (
        (("p1.jpg",), "got a/p1.jpg and b/p1.jpg for p1.jpg: write folder and file"),
        (("p2.jpg", "x/b/p2.jpg"), "got b/p2.jpg for p2.jpg, too, for x/b/p2.jpg"),
        (("c/p1.jpg",), "got boxes in a/p1.jpg, b/p2.jpg, b/p1.jpg: name the files"),
    ):
        with pytest.raises(Refused, match=match):
            find(*names)
    assert box_of_photo(boxes["a/p1.jpg"], "a/p1.jpg", path) is None, "no picture"
    only = coco(tmp_path / "d.json", (1, 1, one), categories=("thing",), images=("a\\p1.jpg", "p3.jpg"))
    assert load_boxes(only, "truck") == {"a/p1.jpg": ((1, 2, 11, 22), (40, 30))}


def test_shares_are_of_the_centered_square():
    def square(*edges_px):
        return box_in_square(tuple(np.divide(edges_px, (40, 30, 40, 30))), (40, 30))

    assert square(10, 0, 30, 30) == pytest.approx((5 / 30, 0, 25 / 30, 1))
    assert square(0, 5, 20, 20) == pytest.approx((0, 5 / 30, 0.5, 20 / 30)), "cut off at its border"
    assert square(0, 5, 5, 20) == (0, 0, 0, 0), "outside, which nothing that is found overlaps"


@pytest.mark.parametrize(
    ("boxes", "categories", "message"),
    [
        (((1, 1, [1, 2, 3, 4]), (1, 1, [2, 2, 3, 4])), ("truck", "patch"), "2 boxes in a/p1.jpg"),
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
    for name, (box, (width, height)) in true.items():
        assert (width, height) == (sizes[name]["width"], sizes[name]["height"])
        margin = (max(width, height) - min(width, height)) / 2
        x, y = (margin, 0) if width > height else (0, margin)  # a report knows what lies in the middle square
        inside = np.clip(box, (x, y, x, y), (width - x, height - y, width - x, height - y))
        assert iou(torch.tensor(told[name].numbers)[None, None], torch.tensor(inside)[None]) > 0.95, name


def test_boxes_elsewhere_take_the_object_away_from_design_and_bare_photographs_even_when_a_run_goes_on(journey):
    names = [path.name for path in sorted(journey.photos.glob("*.jpg"))]
    names += [f"bare/{name}" for name in names]
    corner = [(number, 1, [2 + 80 * (number % 2), 2, 12, 12]) for number in range(1, 7)]  # in and out of the square
    wrong = coco(journey.folder / "w.json", *corner, categories=("box truck",), images=names, size=(640, 480))
    options = {"controls": journey.folder / "controls"}
    (bare,) = verified(journey, "wrong", **options).controls
    assert bare.recognized == 3, "without a box whatever is found counts"
    report = verified(journey, "wrong", **options, capture=pp.CaptureInfo(boxes=wrong), resume=True)
    assert max(answers(report)) < 0.3 and report.controls[0].recognized == 0


def test_boxes_of_other_photographs_are_refused(journey):
    other = coco(journey.folder / "o.json", (1, 1, [1, 2, 3, 4]), categories=("box truck",), images=("x.jpg",))
    with pytest.raises(Refused, match="boxes of these photographs"):
        verified(journey, "other", capture=pp.CaptureInfo(boxes=other))


UPRIGHT = (10, 6, 20, 18)  # edges in the upright photograph of 40 × 30; all that are used say so
TURNED = {5: [6, 10, 12, 10], 6: [6, 20, 12, 10], 7: [12, 20, 12, 10], 8: [12, 10, 12, 10]}  # as stored, by EXIF
XYWH, ONE = [10, 6, 10, 12], ("p1.jpg",)
# by declaration: boxes, and `coco`'s arguments; then EXIF's orientation, or words of what is said
CASES = {
    "`width`, `height`": [([[5, 3, 5, 6]], {"size": (20, 15)}, 1), ([[6.75, 4, 6.75, 8]], {"size": (27, 20)}, 6)],
    "size of the photograph as stored, which EXIF turns": [([b], {"size": (30, 40)}, o) for o, b in TURNED.items()],
    "size of another shape than the photograph's": [
        (
            [XYWH],
            {"size": (30, 30)},
            "p1.jpg of 40 × 30 pixels, or in a copy of all of it, got boxes in a picture of 30",
        ),
        ([XYWH], {"size": (30, 40)}, "boxes in a picture of 30 × 40: draw them in the photographs"),
    ],
    "no `width` or `height`": [([XYWH], {"size": (0, 30)}, 'usable "images.0.width"')],
    "`bbox` outside of the picture, or below a pixel": [
        ([[30, 6, 20, 12]], {}, r"got \[30, 6, 20, 12\] in p1.jpg of 40 × 30 pixels: draw it again"),
        ([[-5, 6, 20, 12]], {}, "draw it again"),
        ([[0.25, 0.2, 0.25, 0.4]], {}, "of a pixel or more"),
        ([[10, 6, 39, 28]], {}, "these are all left, top, right and bottom: write width and height"),
    ],
    "`attributes.rotation` of a box": [([XYWH], {"attributes": {"rotation": 30}}, "got one turned by 30° in p1.jpg")],
    "`iscrowd`": [([XYWH], {"iscrowd": 1}, r"got a group \(iscrowd\) in p1.jpg: draw one upright box")],
    "several boxes of an image": [([XYWH, XYWH], {}, "got 2 boxes in p1.jpg")],
    "`segmentation`": [
        ([XYWH], {"segmentation": [[10, 6, 20, 6, 20, 18]]}, "1 outlines .* are left aside: boxes count")
    ],
    "`category_id`": [([XYWH], {"categories": ("lorry",)}, 1), ([XYWH], {"categories": ("truck", "patch")}, 1)],
    "`file_name` in folders, also with backslashes": [([XYWH], {"images": ("a\\b/p1.jpg",)}, 1)],
    "`file_name` or `id` of an image twice": [([XYWH], {"images": ONE * 2}, "p1.jpg 2 times, or one id twice")],
}


@pytest.mark.parametrize("entry", BOXES_DECLARED, ids=lambda entry: entry.declares)
def test_what_boxes_declare_is_used_refused_or_said(tmp_path, entry):
    for boxes, arguments, outcome in CASES[entry.declares]:
        orientation = outcome if entry.answer == "used" else 1
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.new("RGB", (40, 30) if orientation < 5 else (30, 40)).save(tmp_path / "p1.tif", exif=exif)
        path = coco(tmp_path / "c.json", *((1, 1, box) for box in boxes), **{"images": ONE} | arguments)
        if entry.answer == "refused":
            with pytest.raises(Refused, match=outcome):
                find_in_photos("boxes", load_boxes(path, "truck"), box_of_photo, [("p1.jpg", tmp_path / "p1.tif")])
            continue
        with pytest.warns(UserWarning, match=outcome) if entry.answer == "said" else nullcontext():
            named = [("p1.jpg", tmp_path / "p1.tif")]
            (found,), _ = find_in_photos("boxes", load_boxes(path, "truck"), box_of_photo, named)
        assert found == pytest.approx(tuple(np.divide(UPRIGHT, (40, 30, 40, 30)))), arguments


@pytest.mark.parametrize("load", [lambda path: load_boxes(path, "truck"), load_corners])
def test_a_list_of_results_names_no_photographs_and_is_refused(load, tmp_path):
    (tmp_path / "results.json").write_text('[{"image_id": 1, "category_id": 3, "bbox": [1, 2, 30, 40], "score": 0.9}]')
    with pytest.raises(Refused, match=r"a list without the photographs' names: export annotations, not results\.?$"):
        load(tmp_path / "results.json")
