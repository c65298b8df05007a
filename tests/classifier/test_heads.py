"""Detectors' usual heads: each against a decoder of its own in numpy, cell by cell, by the published formula."""

from __future__ import annotations

import csv
import itertools
import json
import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import patchproof as pp
from patchproof.base.errors import Refused
from patchproof.classifier.head_decoder import HeadDecoder, _plan
from patchproof.classifier.heads import HEADS, head_of
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network_file import load_network

K = 5
YOLO3 = [(10, 13), (16, 30), (33, 23), (30, 61), (62, 45), (59, 119), (116, 90), (156, 198), (373, 326)]
YOLO4 = [(12, 16), (19, 36), (40, 28), (36, 75), (76, 55), (72, 146), (142, 110), (192, 243), (459, 401)]
TINY = [(23, 27), (37, 58), (81, 82), (81, 82), (135, 169), (344, 319)]
FASTEST = [(12, 18), (37, 49), (52, 132), (115, 73), (119, 199), (242, 238)]
YOLO2 = [(0.57273, 0.677385), (1.87446, 2.06253), (3.33843, 5.47434), (7.88282, 3.52778), (9.77052, 9.16828)]


def noise(*shape, spread=1.0):
    count = math.prod(shape)
    values = np.random.default_rng(count).normal(size=count) * spread
    return values.reshape(shape)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def softmax(x):
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def yolo(levels, strides, anchors, version, scales):
    """Darknet's and Ultralytics' boxes and scores, from grids (B·(5+K))×H×W."""
    found, per = [], len(anchors) // len(levels)
    for number, (grid, stride) in enumerate(zip(levels, strides, strict=True)):
        _, height, width = grid.shape
        for y, x, b in itertools.product(range(height), range(width), range(per)):
            t = grid[b * (5 + K) : (b + 1) * (5 + K), y, x]
            w, h = anchors[number * per + b]
            if version in (5, 7):
                cx, cy = (2 * sigmoid(t[0]) - 0.5 + x) * stride, (2 * sigmoid(t[1]) - 0.5 + y) * stride
                w, h = w * (2 * sigmoid(t[2])) ** 2, h * (2 * sigmoid(t[3])) ** 2
            else:
                s = scales[number]
                cx, cy = (
                    (x + sigmoid(t[0]) * s - (s - 1) / 2) * stride,
                    (y + sigmoid(t[1]) * s - (s - 1) / 2) * stride,
                )
                w, h = w * np.exp(t[2]), h * np.exp(t[3])
            names = softmax(t[5:]) if version == 2 else sigmoid(t[5:])
            found.append([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2, *(sigmoid(t[4]) * names)])
    return np.array(found)


def from_deltas(deltas, priors, weights):
    """Faster R-CNN's boxes, from the shift and logarithm of anchors (x, y, width, height)."""
    x, y, w, h = np.array(priors).T
    cx, cy = x + deltas[:, 0] / weights[0] * w, y + deltas[:, 1] / weights[0] * h
    w, h = w * np.exp(deltas[:, 2] / weights[1]), h * np.exp(deltas[:, 3] / weights[1])
    return np.stack([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2], 1)


def retina_priors(size):
    """Lin et al., in torchvision's whole pixels: three sizes of 4 strides an octave, three shapes."""
    for stride in (8, 16, 32, 64, 128):
        side = math.ceil(size / stride)
        for y, x in itertools.product(range(side), range(side)):
            for ratio, octave in itertools.product((0.5, 1, 2), (0, 1 / 3, 2 / 3)):
                area = int(4 * stride * 2**octave) ** 2
                width = math.sqrt(area / ratio)
                yield x * (size // side), y * (size // side), 2 * round(width / 2), 2 * round(width * ratio / 2)


def ssd_priors(size, strides, scales, ratios):
    """Liu et al.: squares of the scale and of its mean with the next one, and each ratio both ways."""
    for level, stride in enumerate(strides):
        shapes = [(scales[level],) * 2, ((scales[level] * scales[level + 1]) ** 0.5,) * 2]
        for ratio in ratios[level]:
            shapes += [(scales[level] * r**0.5, scales[level] / r**0.5) for r in (ratio, 1 / ratio)]
        side = math.ceil(size / stride - 1e-6)
        for y, x in itertools.product(range(side), range(side)):
            for w, h in shapes:
                yield (x + 0.5) * stride, (y + 0.5) * stride, size * min(w, 1), size * min(h, 1)


def points(size, strides, center):
    for stride in strides:
        side = math.ceil(size / stride)
        for y, x in itertools.product(range(side), range(side)):
            yield (x + center) * stride, (y + center) * stride, stride


def from_distances(distances, size, strides, center):
    where = np.array(list(points(size, strides, center)))
    left, top, right, bottom = (distances * where[:, 2:]).T
    x, y, _ = where.T
    return np.stack([x - left, y - top, x + right, y + bottom], 1)


def corners(boxes):
    return np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], 1)


def expectation(bins):
    return (softmax(bins.reshape(len(bins), 4, -1)) * np.arange(bins.shape[1] // 4)).sum(-1)


def grids(size, strides, per):
    return [noise(per * (5 + K), size // stride, size // stride) for stride in strides]


def yolo_case(anchors, strides, version, scales=(1, 1, 1), size=64):
    levels = grids(size, strides, len(anchors) // len(strides))
    return size, levels, yolo(levels, strides, anchors, version, scales)


def ultralytics(objectness):
    boxes, scores, sure = 60 * sigmoid(noise(50, 4)), sigmoid(noise(50, K)), sigmoid(noise(50, 1))
    out = np.concatenate([boxes, *([sure] if objectness else []), scores], 1)
    return 64, [out if objectness else out.T], np.concatenate([corners(boxes), scores * sure**objectness], 1)


def end_to_end():
    boxes, sure = np.tile([4.0, 8, 30, 50], (K, 1)) + noise(K, 4), sigmoid(noise(K, 1))
    rows = np.concatenate([boxes, sure, np.arange(K)[:, None]], 1)
    return 64, [rows], np.concatenate([boxes, sure * np.eye(K)], 1)


def deltas_case(size, priors, weights, background):
    priors = list(priors)
    deltas, logits = noise(len(priors), 4), noise(len(priors), K + background)
    scores = softmax(logits)[:, 1:] if background else sigmoid(logits)
    return size, [logits, deltas], np.concatenate([from_deltas(deltas, priors, weights), scores], 1)


def yolox():
    where = np.array(list(points(64, (8, 16, 32), 0)))
    t, sure = noise(len(where), 4), sigmoid(noise(len(where), 1 + K))
    center, sides = where[:, :2] + t[:, :2] * where[:, 2:], np.exp(t[:, 2:]) * where[:, 2:]
    boxes = corners(np.concatenate([center, sides], 1))
    return 64, [np.concatenate([t, sure], 1)], np.concatenate([boxes, sure[:, :1] * sure[:, 1:]], 1)


def gfl(strides, bins, center, scores_are_shares=True, together=True):
    count = sum((64 // stride) ** 2 for stride in strides)
    logits, distribution = noise(count, K), noise(count, 4 * bins, spread=2)
    boxes = from_distances(expectation(distribution), 64, strides, center)
    first = sigmoid(logits) if scores_are_shares else logits
    outputs = [np.concatenate([first, distribution], 1)]
    if not together:  # by level, boxes first, in planes
        ends = np.cumsum([0, *((64 // stride) ** 2 for stride in strides)])
        both = np.concatenate([distribution, first], 1)
        outputs = [both[a:b].T.reshape(-1, *2 * [64 // s]) for s, a, b in zip(strides, ends, ends[1:], strict=False)]
    return 64, outputs, np.concatenate([boxes, sigmoid(logits)], 1)


def fcos(center):
    strides = (8, 16, 32, 64, 128)
    count = len(list(points(128, strides, center)))
    logits, distances, middle = noise(count, K), np.abs(noise(count, 4)), noise(count, 1)
    scores = np.sqrt(sigmoid(logits) * sigmoid(middle))
    boxes = from_distances(distances, 128, strides, center)
    return 128, [logits, distances, middle], np.concatenate([boxes, scores], 1)


def detr(background):
    boxes, logits = sigmoid(noise(20, 4)), noise(20, K + background)
    scores = softmax(logits)[:, :-1] if background else sigmoid(logits)
    return 64, [logits, boxes], np.concatenate([64 * corners(boxes), scores], 1)


SSD_RATIOS = [(2,), (2, 3), (2, 3), (2, 3), (2,), (2,)]
SSD_SCALES = [0.07, 0.15, 0.33, 0.51, 0.69, 0.87, 1.05]
LITE_SCALES = [*(0.2 + 0.75 * k / 5 for k in range(6)), 1.0]
CASES = {
    "yolov2": lambda: yolo_case([(32 * w, 32 * h) for w, h in YOLO2], [32], 2),
    "yolov3": lambda: yolo_case(YOLO3, [8, 16, 32], 3),
    "yolov3-tiny": lambda: yolo_case(TINY, [16, 32], 3),
    "yolov4": lambda: yolo_case(YOLO4, [8, 16, 32], 4, (1.2, 1.1, 1.05)),
    "yolov4-tiny": lambda: yolo_case(TINY, [16, 32], 4, (1.05, 1.05)),
    "yolov5": lambda: yolo_case(YOLO3, [8, 16, 32], 5),
    "yolov7": lambda: yolo_case(YOLO4, [8, 16, 32], 7),
    "yolo-fastest": lambda: yolo_case(FASTEST, [16, 32], 3),
    "yolox": yolox,
    "ultralytics": lambda: ultralytics(0),
    "ultralytics with objectness": lambda: ultralytics(1),
    "ultralytics end to end": end_to_end,
    "yolov8-raw": lambda: gfl((8, 16, 32), 16, 0.5, False, False),
    "nanodet": lambda: gfl((8, 16, 32), 8, 0.5),
    "nanodet-plus": lambda: gfl((8, 16, 32, 64), 8, 0),
    "picodet": lambda: gfl((8, 16, 32, 64), 8, 0.5),
    "fcos": lambda: fcos(0.5),
    "torchvision-fcos": lambda: fcos(0),
    "retinanet": lambda: deltas_case(128, retina_priors(128), (1, 1), 0),
    "ssd300": lambda: deltas_case(300, ssd_priors(300, (8, 16, 32, 64, 100, 300), SSD_SCALES, SSD_RATIOS), (10, 5), 1),
    "ssdlite320": lambda: deltas_case(
        320, ssd_priors(320, (16, 32, 64, 320 / 3, 160, 320), LITE_SCALES, 6 * [(2, 3)]), (10, 5), 1
    ),
    "detr": lambda: detr(1),
    "detr without background": lambda: detr(0),
}
GUESSED = [
    name for name in CASES if not name.startswith(("yolov2", "yolov3", "yolov4", "yolov5", "yolov7", "yolo-", "yolox"))
]


def decoded(size, outputs, head=None, names=()):
    tensors = [torch.tensor(output[None]).float() for output in outputs]
    return HeadDecoder("it", K, size, head)([*names, *len(tensors) * [""]][: len(tensors)], *tensors)[0]


def assert_equal(candidates, truth, atol=1e-3):
    np.testing.assert_allclose(candidates[:, :4], truth[:, :4], rtol=1e-5, atol=atol)
    np.testing.assert_allclose(torch.sigmoid(candidates[:, 4:].double()), truth[:, 4:], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_boxes_and_scores_are_those_of_the_published_formula(case):
    size, outputs, truth = CASES[case]()
    assert_equal(decoded(size, outputs, head_of(case.split(" ")[0], "here")), truth)


def test_every_head_has_a_case():
    assert set(HEADS) - {"boxes"} == {case.split(" ")[0] for case in CASES}


@pytest.mark.parametrize("case", GUESSED)
def test_a_head_is_guessed_from_shapes_and_said(case):
    _plan.cache_clear()  # a warning is given once for a network
    size, outputs, truth = CASES[case]()
    name = {"picodet": "nanodet-plus", "fcos": "torchvision-fcos"}.get(case, case.split(" ")[0])
    with pytest.warns(UserWarning, match=rf'it gives N×.*, read as the head "{name}": write "head"'):
        candidates = decoded(size, outputs)
    if name == case.split(" ")[0]:
        assert_equal(candidates, truth)


def swapped(grid):
    """The other forms of planes (B·C)×H×W: H×W×(B·C), B×H×W×C and H×W×B×C."""
    apart = grid.reshape(3, 5 + K, *grid.shape[1:])
    return [grid.transpose(1, 2, 0), apart.transpose(0, 2, 3, 1), apart.transpose(2, 3, 0, 1)]


@pytest.mark.parametrize("form", range(3))
def test_grids_may_have_their_anchors_and_columns_anywhere(form):
    size, outputs, truth = CASES["yolov5"]()
    head = head_of("yolov5", "here")
    assert_equal(decoded(size, [swapped(grid)[form] for grid in reversed(outputs)], head), truth)  # levels, too


def test_own_anchors_and_strides_replace_those_of_the_name():
    anchors, strides = [(5, 9), (11, 7), (20, 30), (40, 25)], [4, 16]
    size, outputs, truth = yolo_case(anchors, strides, 3)
    head = head_of({"name": "yolov3", "anchors": [anchors[:2], anchors[2:]]}, "here")
    assert_equal(decoded(size, outputs, head), truth)
    with pytest.raises(Refused, match=r"boxes of the head yolov3 on 2 levels, cells a side: \(16, 8, 4\), got N×"):
        decoded(size, [*outputs[:1], *grids(64, (8, 16), 2)], head)


@pytest.mark.parametrize(
    ("boxes", "change"),
    [
        ("xyxy", lambda b: b),
        ("yxyx", lambda b: b[:, [1, 0, 3, 2]]),
        ("xywh", lambda b: np.hstack([b[:, :2], b[:, 2:] - b[:, :2]])),
        ("cxcywh", lambda b: np.hstack([(b[:, :2] + b[:, 2:]) / 2, b[:, 2:] - b[:, :2]])),
    ],
)
@pytest.mark.parametrize("unit", ["pixels", "share"])
def test_decoded_boxes_come_in_any_order_and_unit(boxes, change, unit):
    corner, scores = 30 * sigmoid(noise(9, 2)), sigmoid(noise(9, K))
    truth = np.hstack([corner, corner + 20 * sigmoid(noise(9, 2)), scores])
    values = change(truth[:, :4]) / (64 if unit == "share" else 1)
    head = head_of({"name": "boxes", "boxes": boxes, "unit": unit, "scores": "probabilities"}, "here")
    assert_equal(decoded(64, [np.hstack([values, scores])], head), truth)
    assert_equal(decoded(64, [scores, values], head), truth)


def grid_boxes():
    """Boxes of a grid of 8×8 cells, of all sizes, with shares of a softmax over the labels and a background."""
    y, x = np.mgrid[:8, :8].reshape(2, 64) * 8 + 4
    sides = 4 + 20 * sigmoid(noise(64, 2))
    shares = softmax(np.concatenate([noise(64, K), np.full((64, 1), 2.0)], 1))
    return np.hstack([np.stack([x, y], 1) - sides / 2, np.stack([x, y], 1) + sides / 2]), shares


def center_size(boxes):
    return np.hstack([(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]])


def upper_size(boxes):
    return np.hstack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])


def logit(share):
    return np.log(share / (1 - share))


S = np.s_[:, :K]  # the labels' columns
UNTOLD = {  # by what is said: outputs from boxes b and shares p
    "": (lambda b, p: [np.hstack([b, logit(p[S])])]),
    '{"name": "boxes", "unit": "share"}': (lambda b, p: [np.hstack([b / 64, logit(p[S])])]),
    '{"name": "boxes", "boxes": "yxyx", "scores": "probabilities"}': (
        lambda b, p: [np.hstack([b[:, [1, 0, 3, 2]], p[S]])]
    ),
    '{"name": "boxes", "boxes": "xywh"}': (lambda b, p: [np.hstack([upper_size(b), logit(p[S])])]),
    '{"name": "boxes", "columns": ["scores", "boxes"]}': (lambda b, p: [np.hstack([logit(p[S]), b])]),
    '{"name": "ultralytics", "boxes": "xyxy"}': (lambda b, p: [np.hstack([b, p[S]]).T]),
    '{"name": "ultralytics", "unit": "share", "scores": "logits"}': (
        lambda b, p: [np.hstack([center_size(b) / 64, logit(p[S])]).T]
    ),
    '{"name": "ultralytics", "columns": ["scores", "boxes"]}': (lambda b, p: [np.hstack([p[S], center_size(b)]).T]),
    '{"name": "ultralytics", "boxes": "xyxy", "background": "last"}': (lambda b, p: [np.hstack([b, p])]),
    '{"name": "ultralytics", "boxes": "xyxy", "background": "first"}': (
        lambda b, p: [np.hstack([b, np.roll(p, 1, 1)])]
    ),
    '{"name": "detr", "boxes": "xyxy", "unit": "pixels"}': (lambda b, p: [logit(p[S]).T, b]),
    '{"name": "detr", "scores": "probabilities"}': (lambda b, p: [center_size(b) / 64, p]),
    '{"name": "detr", "boxes": "yxyx", "background": "first"}': (
        lambda b, p: [b[:, [1, 0, 3, 2]] / 64, np.roll(np.log(p), 1, 1)]
    ),
    '{"name": "detr", "unit": "pixels", "scores": "probabilities"}': (
        lambda b, p: [p[S] / 0.9, np.full((64, 1), 0.9), center_size(b)]
    ),
}


@pytest.mark.parametrize("words", UNTOLD)
def test_decoded_boxes_of_an_untold_head_are_read_by_what_they_hold_and_said(words):
    """What is said, written into the JSON, reads the same."""
    boxes, shares = grid_boxes()
    outputs, truth = UNTOLD[words](boxes, shares), np.hstack([boxes, shares[S]])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert_equal(decoded(64, outputs), truth)
    assert [re.sub(r'.*read as the head (.*): write "head" .*', r"\1", str(each.message)) for each in said] == (
        [words] if words else []
    )
    if words:
        assert_equal(decoded(64, outputs, head_of(json.loads(words), "here")), truth)


def test_rows_of_detections_may_be_shares_and_in_another_order_are_refused():
    size, (rows,), truth = end_to_end()
    with pytest.warns(UserWarning, match=r'head \{"name": "ultralytics", "boxes": "xyxy", "unit": "share"\}'):
        assert_equal(decoded(size, [np.hstack([rows[:, :4] / size, rows[:, 4:]])]), truth)
    sure, label = sigmoid(noise(60, 1)), np.arange(60)[:, None] % K
    boxes = np.hstack([0.5 + np.tanh(noise(60, 2)) / 2, 0.1 + 0.3 * sigmoid(noise(60, 2))])  # RT-DETR's
    with pytest.warns(UserWarning, match=r'head \{"name": "ultralytics", "unit": "share"\}'):
        found = decoded(size, [np.hstack([boxes, sure, label])])
    assert_equal(found, np.hstack([size * corners(boxes), sure * np.eye(K)[label[:, 0]]]))
    with pytest.raises(Refused, match=r"rows of a box, a score and a label's number, got N×5×6"):
        decoded(size, [rows[:, [5, 4, 0, 1, 2, 3]]])


def test_a_column_that_may_be_a_background_or_an_objectness_is_refused():
    boxes, shares = grid_boxes()
    with pytest.raises(Refused, match=r"what stands beside 5 scores, got N×64×10 .*objectness, or .*background"):
        decoded(64, [np.hstack([boxes, np.log(shares)])])
    with pytest.raises(Refused, match="a detector's head for 5 labels, got N×64×4 and N×64 and N×"):
        decoded(64, [boxes, shares[:, 0], np.array(64.0)])


def test_outputs_of_one_shape_are_told_apart_by_name(monkeypatch):
    monkeypatch.setattr("test_heads.K", 3)  # and a background: four columns, as boxes have
    size, outputs, truth = detr(1)
    head = head_of("detr", "here")
    assert_equal(decoded(size, outputs, head, ["pred_logits", "pred_boxes"]), truth)
    assert_equal(decoded(size, outputs, head_of({"name": "detr", "outputs": ["scores", "boxes"]}, "here")), truth)
    with pytest.raises(
        Refused, match=r'differ in shape or name, got N×20×4 and N×20×4 .*"outputs": \["boxes", "scores"\]'
    ):
        decoded(size, outputs, head)


@pytest.mark.parametrize("case", ["ultralytics with objectness", "nanodet", "ssd300", "detr", "yolov2", "fcos"])
def test_scores_and_boxes_have_gradients(case):
    size, outputs, _ = CASES[case]()
    tensors = [torch.tensor(output[None]).float().requires_grad_() for output in outputs]
    candidates = HeadDecoder("it", K, size, head_of(case.split(" ")[0], "here"))(["", "", ""], *tensors)
    for part in (candidates[..., :4], candidates[..., 4:]):
        found = torch.autograd.grad(part.sum(), tensors, retain_graph=True, allow_unused=True)
        assert all(each is None or torch.isfinite(each).all() for each in found)
        assert max(float(each.abs().max()) for each in found if each is not None) > 0.01


def test_logits_where_shares_are_expected_are_refused():
    size, (table,), _ = CASES["nanodet"]()
    with pytest.raises(Refused, match=r'scores in 0 to 1 from the head nanodet, got scores from -.*"scores": "logits"'):
        decoded(size, [table * 3 - 1], head_of("nanodet", "here"))


def test_grids_that_only_values_tell_apart_are_refused_with_the_names():
    size, outputs, _ = CASES["yolov5"]()
    with pytest.raises(Refused, match=r"a detector's head for 5 labels, got N×30×8×8 and .*: write .*yolov3, .*yolov7"):
        decoded(size, outputs)


def network(outputs, **attributes):
    """A module that gives these outputs for each picture, a little brighter with it."""
    made = torch.nn.Module()
    tensors = {name: torch.tensor(value).float() for name, value in outputs.items()}
    made.forward = lambda x: {
        name: each * (1 + 0.1 * x[:, 0].mean((1, 2))[:, None, None]) for name, each in tensors.items()
    }
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def test_modules_say_their_head_and_return_dictionaries():
    size, (logits, boxes), truth = detr(1)
    raw = network({"pred_logits": logits, "pred_boxes": boxes}, input_px=size, labels="a b c d e".split())
    with pytest.raises(Refused, match=r'logits alone, as a tensor, or give it kind = "detector", and a head for'):
        load_classifier(raw)
    raw.kind, raw.head = "detector", "detr"
    assert_equal(load_classifier(raw).network(torch.zeros(1, 3, size, size))[0], truth)
    with pytest.warns(UserWarning, match=r'N×20×6 and N×20×4, read as the head "detr"'):
        pp.detector_of(raw, size, raw.labels).network(torch.zeros(1, 3, size, size))


RAW = {  # what each shared detector computes before our conversion decodes it, and its head
    "yolo_fastest_1.1_xl_320": (["/convs.120/Conv_output_0", "/convs.129/Conv_output_0"], "yolo-fastest"),
    "nanodet_m_416": (
        [f"/net/Slice_{number}_output_0" for number in range(26, 32)],
        {"name": "nanodet", "scores": "logits"},
    ),
}


@pytest.mark.parametrize("name", RAW)
def test_both_shared_detectors_are_read_without_our_conversion(name, data, tmp_path):
    """Cut before their boxes are decoded: the candidates of the whole files."""
    onnx = pytest.importorskip("onnx", reason='needs onnx, of the extra "test"')
    (outputs, head), made = RAW[name], onnx.load(str(data / f"detectors/{name}.onnx"))
    needed, nodes = set(outputs), []
    for node in reversed(made.graph.node):
        if needed & set(node.output):
            nodes, needed = [node, *nodes], needed | set(node.input)
    for field in (made.graph.node, made.graph.output):
        del field[:]
    made.graph.node.extend(nodes)
    for output in outputs:
        made.graph.output.add(name=output)
    onnx.save(made, str(tmp_path / f"{name}.onnx"))
    card = json.loads((data / f"detectors/{name}.json").read_text())
    (tmp_path / f"{name}.json").write_text(json.dumps(card | {"head": head}))
    folders, photo = (tmp_path, data / "detectors"), torch.rand(1, 3, *2 * [card["input_px"]])
    raw, whole = (load_network(folder / f"{name}.onnx").network(photo)[0] for folder in folders)
    if name.startswith("yolo"):  # level by level from the coarsest on, and anchor by anchor
        levels = [part.reshape(3, -1, 84).transpose(0, 1).reshape(-1, 84) for part in whole.split([300, 1200])]
        whole = torch.cat(levels[::-1])
    torch.testing.assert_close(raw[:, :4], whole[:, :4], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(raw[:, 4:].sigmoid(), whole[:, 4:].sigmoid(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("rows", "last"), [(300, "labels"), (1344, "scores")])
def test_six_columns_of_one_label_are_rows_that_were_kept_or_candidates_with_an_objectness(rows, last):
    layouts, _, count = _plan(HeadDecoder("it", 1, 64), head_of("ultralytics", "here"), ("output0",), ((rows, 6),))
    assert layouts[0][1][-1] == last and count == rows


def test_the_notebook_s_figures_of_heads_are_those_of_the_stored_trials():
    """`python tests/head_trials.py` made them."""
    results = Path(__file__).parents[2] / "src/patchlab/results"
    with (results / "detector" / "heads.csv").open(encoding="utf-8", newline="") as file:
        trials = list(csv.DictReader(file))
    found, otherwise, lost = (sum(int(row[key]) for row in trials) for key in ("detections", "cut otherwise", "lost"))
    box_px, score = (max(float(row[key]) for row in trials) for key in ("box off px", "score off"))
    said = f"{found:,} detections, of which {otherwise:,} are cut otherwise and {lost} is lost; others' boxes within "
    assert said + f"{box_px:.2g} px, scores within {score:.2g}" in (results / "measured.md").read_text(encoding="utf-8")
    assert len(trials) == 14 and {row["photographs"] for row in trials} == {"100"}


def test_the_page_of_networks_tells_every_head():
    page = (Path(__file__).parents[2] / ".readme" / "networks.md").read_text(encoding="utf-8")
    table = "".join(line.split("|")[1] for line in page.splitlines() if line.startswith("| `"))
    named = re.findall(r"`([\w-]+)`", table)
    assert sorted(named) == sorted(HEADS)
