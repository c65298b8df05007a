"""Detectors: boxes of meshes, what counts as seen, the words they share with classifiers, and the one that ships."""

import importlib
import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import patchproof as pp
from patchlab.training import pictures as rendered
from patchlab.training import train_detector
from patchproof.base.errors import Refused
from patchproof.base.geometry import intrinsics, project
from patchproof.base.goal import Goal
from patchproof.channel.object_box import MOST_POINTS, hull_points, project_box
from patchproof.classifier.builtin import WEIGHTS_FOLDER
from patchproof.classifier.builtin_detector import INPUT_PX
from patchproof.classifier.detector import NO_BOX_LOGIT, Detector, iou
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network_file import read_card
from patchproof.optimizer.subject import target_loss
from patchproof.render.stage import set_stage
from patchproof.render.views import render_views

FOUR = [0.25, 0.25, 0.75, 0.75]


def candidates(*rows):
    """A network that gives the same candidates for every picture: (left, top, right, bottom), logits."""
    table = torch.tensor([[*box, *logits] for box, logits in rows])
    return lambda photos: table[None].expand(len(photos), -1, -1) + 0 * photos.mean()


def detector(*rows, **kwargs):
    return Detector("made", None, 8, ("cat", "dog"), candidates(*rows), **kwargs)


def test_the_best_candidate_on_the_object_is_what_counts():
    made = detector(([0, 0, 8, 8], [3.0, 9.0]), ([2, 2, 6, 6], [1.0, -2.0]), ([2, 2, 6, 5], [2.0, -4.0]))
    photo, box = torch.rand(1, 3, 8, 8), np.array([FOUR])
    # the first one's overlap is 16 / 64, the others' 1 and 3 / 4
    assert made.logits(photo, box).tolist() == [[2.0, -2.0]]
    assert made.logits(photo).tolist() == [[3.0, 9.0]]  # nobody knows where: anywhere
    assert made.logits(photo, np.array([[0.9, 0.9, 1.0, 1.0]])).tolist() == [[NO_BOX_LOGIT, NO_BOX_LOGIT]]
    assert made.target_box(photo, (0,), box) == (0.25, 0.25, 0.75, 0.625)  # in shares of the square
    assert made.target_box(photo, (1,), box) == tuple(FOUR) and made.target_box(photo, (0,), None) == (0, 0, 1, 1)
    assert made.target_box(photo, (0,), np.array([[0.9, 0.9, 1.0, 1.0]])) is None
    logits = made.logits(photo, box)
    assert made.confidence(logits, (0,)).item() == pytest.approx(1 / (1 + math.exp(-2)))
    assert made.confidence(logits, (0, 1)).item() == made.confidence(logits, (0,)).item()  # the best, not the sum
    assert made.recognized(logits, (0,)).item() and not made.recognized(logits, (1,)).item()


@pytest.mark.parametrize(("share", "counts"), [(0.51, True), (0.49, False)])
def test_half_an_overlap_is_the_last_that_counts(share, counts):
    made = detector(([0, 0, 8 * share, 8], [4.0, 0.0]))
    assert made.recognized(made.logits(torch.rand(1, 3, 8, 8), np.array([[0, 0, 1, 1]])), (0,)).item() is counts


@pytest.mark.parametrize(("score", "counts"), [(0.7, True), (0.75, False)])
def test_the_score_from_which_on_boxes_count_is_the_scene_s(score, counts):
    made = detector(([2, 2, 6, 6], [1.0, 0.0])).with_least_score(score)  # a score of 0.731
    assert made.recognized(made.logits(torch.rand(1, 3, 8, 8), np.array([FOUR])), (0,)).item() is counts
    plain = pp.Classifier("plain", None, 8, ("a",), lambda x: x)
    assert plain.with_least_score(score) is plain


def test_losses_fall_where_the_goal_is_reached_and_keep_their_gradient():
    made = detector(([0, 0, 8, 8], [0.0, 0.0]))
    for logit in (-60.0, 0.0, 60.0):
        logits = torch.tensor([[logit, 0.0]], requires_grad=True)
        likely, rest = (term.item() for term in made.odds(logits, (0,)))
        assert likely == pytest.approx(-math.log1p(math.exp(-logit)))
        assert rest == pytest.approx(-math.log1p(math.exp(logit)))
    for goal in Goal:
        wrong = torch.tensor([[-60.0 * goal.sign, 0.0]], requires_grad=True)
        (gradient,) = torch.autograd.grad(target_loss(made.odds(wrong, (0,)), goal).sum(), wrong)
        assert gradient[0, 0].item() == pytest.approx(-goal.sign)


def test_overlaps_are_those_of_counted_pixels():
    rng = np.random.default_rng(0)
    boxes = np.sort(rng.integers(0, 30, (40, 2, 2)), axis=1).reshape(40, 4)
    truth = np.array([5, 7, 22, 19])
    y, x = np.mgrid[:30, :30]

    def cells(box):
        return (x >= box[0]) & (x < box[2]) & (y >= box[1]) & (y < box[3])

    counted = [(cells(b) & cells(truth)).sum() / max((cells(b) | cells(truth)).sum(), 1) for b in boxes]
    ours = iou(torch.tensor(boxes)[None].float(), torch.tensor(truth)[None].float())[0]
    np.testing.assert_allclose(ours, counted, atol=1e-6)


def test_a_box_holds_every_pixel_of_the_object_and_no_more():
    """Against the rasterizer: the object's own pixels in a bare view on a plain background."""
    settings = {
        "object": {"mesh": "python:spot", "length_mm": 300},
        "patch": {"width_mm": 40, "height_mm": 40},
        "target": {"label": 0, "models": ["builtin"]},
        "camera": {"photo_px": [320, 240]},
        "view": {"look_at_jitter": 0.15, "roll_deg": [-20, 20]},
    }
    scene = pp.make_scene(settings, trimesh.creation.box((3, 2, 1)))
    stage, conditions = set_stage(scene), scene.draw("evaluate", 6)
    for i, box in enumerate(scene.boxes(conditions)):
        seen = render_views(stage, None, conditions[[i]], (200, 200))
        rows, columns = np.divmod(seen.on_object.pixel.numpy(), 200)
        drawn = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        assert np.abs(box * 200 - drawn).max() <= 1.0


def test_many_points_and_few_give_the_same_box():
    sphere = trimesh.creation.icosphere(5).vertices * 100.0
    few = hull_points(np.asarray(sphere))
    assert len(sphere) > 10_000 and len(few) <= MOST_POINTS
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = Rotation.from_euler("xyz", (0.3, 0.8, -0.5)).as_matrix(), 600
    size = (400, 400)
    whole, thinned = (project_box(points, pose, intrinsics(40, size), size) for points in (sphere, few))
    assert np.abs(whole - thinned).max() < 0.01 * (whole[2] - whole[0])
    assert len(hull_points(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))) == 3  # flat meshes have no hull


def test_boxes_are_clipped_and_nothing_in_view_has_none():
    points, size = np.array([[-50.0, -50, 0], [50, 50, 0]]), (100, 80)
    pose = np.eye(4)
    pose[2, 3] = 10.0
    np.testing.assert_array_equal(project_box(points, pose, intrinsics(60, size), size), [0, 0, 100, 80])
    pose[2, 3] = -10.0  # behind the camera
    np.testing.assert_array_equal(project_box(points, pose, intrinsics(60, size), size), 0)
    pose[:3, 3] = 1000, 0, 10
    np.testing.assert_array_equal(project_box(points, pose, intrinsics(60, size), size), 0)
    assert project(intrinsics(60, size), pose, points).shape == (2, 2)


class Found(torch.nn.Module):
    """As torchvision's detectors: a list of dictionaries, here of one box whose score is the picture's brightness."""

    def forward(self, photos):
        box = torch.tensor([[2.0, 2, 6, 6]])
        return [{"boxes": box, "labels": torch.tensor([1]), "scores": p.mean()[None]} for p in photos]


def test_findings_of_any_number_become_candidates_with_gradients():
    made = pp.detector_of(Found(), 8, ["none", "cat"])
    photos = torch.full((2, 3, 8, 8), 0.75).requires_grad_()
    logits = made.logits(photos, np.array([FOUR, [0, 0, 0.2, 0.2]]))
    assert logits[0].tolist() == [NO_BOX_LOGIT, pytest.approx(math.log(3))]
    assert logits[1].tolist() == [NO_BOX_LOGIT, NO_BOX_LOGIT]
    (gradient,) = torch.autograd.grad(logits.sum(), photos)
    assert gradient[0].sum().item() == pytest.approx(1 / 0.75 + 1 / 0.25) and not gradient[1].any()


def test_labels_that_count_from_one_are_refused_and_a_single_label_is_read(tmp_path):
    with pytest.raises(Refused, match=r'labels from 0 to 0, got 1 from the network: .* "background" first'):
        pp.detector_of(Found(), 8, ["cat"]).logits(torch.full((1, 3, 8, 8), 0.75), np.array([FOUR]))
    (tmp_path / "a.json").write_text('{"input_px": 8, "labels": ["cat"], "kind": "detector"}')
    assert read_card(tmp_path / "a.json").labels == ("cat",)


class Blind(torch.nn.Module):
    def forward(self, photos):
        empty = photos.new_zeros(0)
        return [{"boxes": empty.view(0, 4), "labels": empty.long(), "scores": empty} for _ in photos]


def test_a_detector_that_finds_nothing_is_doubted_aloud():
    with pytest.warns(UserWarning, match="finds nothing in smooth pictures"):
        load_classifier(pp.detector_of(Blind(), 8, ["cat"]), WEIGHTS_FOLDER)


def test_a_detector_with_another_number_of_labels_is_refused():
    made = Detector("made", None, 8, ("cat", "dog", "owl"), candidates(([0, 0, 8, 8], [3.0, 9.0])))
    with pytest.raises(
        Refused, match=r"candidates 3×A×7: left, .* 3 logits, got \(3, 1, 6\) for 3 pictures from the network made"
    ):
        load_classifier(made, WEIGHTS_FOLDER)


# ------------------------------------------------------------------------------------------------ the one that ships


@pytest.fixture(scope="module")
def shipped():
    return load_classifier("builtin-detector", WEIGHTS_FOLDER)


@pytest.fixture(scope="module")
def fresh():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendered, "VIEWS_PER_SHAPE", 2)
        return rendered.render_pictures(2, 7_000_000, INPUT_PX)


def test_it_is_small_and_finds_fresh_objects_about_as_well_as_its_card_says(shipped, fresh):
    card = json.loads((WEIGHTS_FOLDER / "builtin_detector.json").read_text())
    assert card["held_out_ap50"] >= 0.8 and (WEIGHTS_FOLDER / "builtin_detector.safetensors").stat().st_size < 5_000_000
    found = train_detector.ap50_by_class(train_detector.detections_by_class(shipped.network, fresh), fresh)
    assert shipped.least_score == card["least_score"]
    assert found.mean() > card["held_out_ap50"] - 0.15  # two views of one shape are alike


@pytest.fixture
def two_stage(monkeypatch):
    """Proposals and names by two networks, as R-CNN: the user's own code."""
    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[2] / "src/patchlab/results/detector")
    return importlib.import_module("two_stage")


def test_two_stages_find_fresh_objects_and_pass_gradients(two_stage, fresh):
    made = two_stage.rcnn()
    assert train_detector.score_network(made.network, fresh).mean() >= 0.8
    photo, box, index = fresh.images[:1].float() / 255, fresh.boxes[:1].numpy(), fresh.labels[:1].tolist()
    before = made.logits(photo.requires_grad_(), box)[0, index]
    (gradient,) = torch.autograd.grad(before.sum(), photo)
    up, down = (made.logits(photo.detach() + step * gradient.sign(), box)[0, index] for step in (0.01, -0.01))
    assert up > before > down  # not a difference to the last digit: where it is cut out has no gradient


def test_crops_are_opencv_s(two_stage):
    photo, box = torch.rand(1, 3, 128, 128), torch.tensor([[[30.0, 20.0, 90.0, 100.0]]])
    side = two_stage.MARGIN * 80
    scale = side / two_stage.CROP_PX
    left, top = 60 - side / 2, 60 - side / 2
    matrix = np.array([[scale, 0, left + scale / 2 - 0.5], [0, scale, top + scale / 2 - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = two_stage.CROP_PX, two_stage.CROP_PX
    theirs = cv2.warpAffine(photo[0].permute(1, 2, 0).numpy(), matrix, size, flags=flags, borderValue=(0.5,) * 3)
    np.testing.assert_allclose(two_stage.crops(photo, box)[0].permute(1, 2, 0), theirs, atol=0.04)


def test_detectors_carry_a_run_from_scene_to_verdict(tmp_path, shipped, two_stage, monkeypatch):
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 2)
    monkeypatch.setattr(two_stage, "PROPOSALS", 2)  # each is cut out and named: most of the time
    monkeypatch.setattr("patchproof.classifier.wrapping.MOST_WEIGHTS", 0)  # no other ranges of colors are tried
    names = ["builtin-detector", "module:two_stage.rcnn"]
    scene = pp.make_scene(
        {
            "object": {"mesh": "primitive:box_truck", "length_mm": 400},
            "patch": {"width_mm": 120, "height_mm": 120, "side": "+x"},
            "target": {"label": "box truck", "models": names, "least_score": 0.4},
            "background": {"color": [0.5, 0.5, 0.5]},
            "camera": {"photo_px": [320, 240]},
            "optimize": {"steps": 2, "views": 2},
        }
    )
    run = pp.optimize(scene, tmp_path / "run", promise=pp.PromiseOptions(8, ("bare",)))
    assert [(claim.name, claim.least_score) for claim in run.promise.models] == [(name, 0.4) for name in names]
    assert 3 < len(run.promise.outermost_mm) <= MOST_POINTS
    pp.sheet(run, tmp_path / "sheet.pdf")
    pp.reprint(tmp_path / "sheet.pdf", run, 2, tmp_path / "photos")
    assert [*pp.evaluate(run.folder, n=2, trust=True).models] == names
    sheet, out = tmp_path / "sheet.json", tmp_path / "report"
    report = pp.verify(tmp_path / "photos", sheet, out, models=names, ledger_photos=1)
    page = (tmp_path / "report" / "report.html").read_text("utf-8")
    rule = "recognized is a photograph with a box of “box truck”, of score 0.4 or more, over the piece&#39;s object"
    assert rule in page.split("<h2>")[0]
    counts = re.findall("counts from 40[^<]* on, in a box over the object; surest there: ", page)
    assert len(counts) == 4  # networks and photographs
    assert page.count('aria-label="the object') == 3  # with the photograph of the first screen
    found = sum(entry.predictions[names[0]].target_box is not None for entry in report.photos)
    assert found <= page.count('aria-label="the target') <= found + 1
    shown = re.findall(r">([^<>]*) <span[^<]*</span><br>(?:not )?recognized", page)
    assert shown and set(shown) == {"box truck"}
    truth = scene.boxes(scene.draw("reprint", 2))
    for name, loaded in zip(names, (shipped, two_stage.rcnn()), strict=True):
        network = loaded.with_least_score(0.4)
        for photo, box in zip(report.photos, truth, strict=True):
            answer = photo.predictions[name]
            pixels = torch.tensor(np.asarray(Image.open(tmp_path / "photos" / photo.file).convert("RGB")))
            logits = network.logits(pixels.permute(2, 0, 1)[None] / 255, box[None])
            assert answer.target_confidence == pytest.approx(network.confidence(logits, (4,)).item(), abs=0.02)
            assert answer.recognized == (answer.target_confidence >= 0.4)


# one candidate, whose logits are the picture's mean red and blue
BRIGHT = """mean = GlobalAveragePool(x) colors = Reshape(mean, [0, 1, 3]) logits = Gather<axis=2>(colors, [0, 2])
    box = Reshape([2.0, 2.0, 6.0, 6.0], [1, 1, 4]) s = Shape<end=1>(x) n = Concat<axis=0>(s, [1, 1])
    boxes = Expand(box, n) y = Concat<axis=2>(boxes, logits)"""


@pytest.mark.parametrize(("kind", "refused"), [("detector", None), ("segmenter", 'kind, "classifier" or "detector"')])
def test_an_exported_detector_says_so_in_its_json(tmp_path, kind, refused):
    pytest.importorskip("onnx", reason='needs onnx, of the extra "test"')
    import onnx_files

    onnx_files.save(tmp_path, onnx_files.model(BRIGHT), ["red", "blue"], "net", kind)
    if refused:
        with pytest.raises(Refused, match=refused):
            load_classifier("file:net.onnx", tmp_path)
        return
    made, photo = load_classifier("file:net.onnx", tmp_path), torch.rand(1, 3, 8, 8)
    assert isinstance(made, Detector)
    torch.testing.assert_close(made.logits(photo, np.array([FOUR])), photo.mean((2, 3))[:, ::2])
    assert made.logits(photo, np.array([[0, 0, 0.2, 0.2]])).tolist() == [[NO_BOX_LOGIT, NO_BOX_LOGIT]]
