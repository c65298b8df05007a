"""The heads that detectors usually have: how their outputs become boxes and scores, one row a head.

In: `"head"` of a network's JSON: a row's name, or a table of a name and values that replace the row's. Out: a `Head`.

Sources: github.com/ultralytics/ultralytics (the exports, DFL), pjreddie.com/darknet and github.com/AlexeyAB/darknet
(YOLO 2 to 4), github.com/Megvii-BaseDetection/YOLOX, github.com/RangiLyu/nanodet, torchvision's detection models (SSD,
RetinaNet, FCOS), Tian et al., "FCOS", Carion et al., "End-to-End Object Detection with Transformers".
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from patchproof.base.errors import Refused
from patchproof.base.validation import Finite, Positive, Share, StrictModel, spelling_hint, validate_model

Sizes = tuple[Positive, Positive]


class Head(StrictModel):
    """What `"head"` in a network's JSON may say."""

    name: str
    formula: Literal["none", "deltas", "grid", "squares", "distances"] = "none"  # from a cell and its anchor to a box
    boxes: Literal["xyxy", "yxyx", "xywh", "cxcywh"] = "xyxy"  # the order of their four numbers
    unit: Literal["pixels", "share"] = "pixels"  # or shares of the input's side
    scores: Literal["logits", "probabilities", "softmax"] = "logits"  # softmax: over the logits of all labels
    background: Literal["", "first", "last"] = ""  # among K+1 scores
    exponent: Share = 1.0  # of score · objectness
    columns: tuple[Literal["boxes", "objectness", "scores"], ...] = ("boxes", "objectness", "scores")  # in one table
    outputs: tuple[str, ...] = ()  # what each output holds, as in `columns`, where shapes and names do not tell
    bins: Annotated[int, Field(ge=0, le=64)] = 0  # of a distance's distribution, from 0 on; 0: the distance itself
    strides: tuple[Positive, ...] = ()  # pixels between the cells of each level; by default the outputs'
    floor: bool = False  # strides are input_px over the number of cells, rounded down, as torchvision has them
    center: Finite = 0.5  # of the first cell, in strides
    anchors: tuple[Annotated[tuple[Sizes, ...], Field(min_length=1)], ...] = ()  # of a cell, in pixels, by level
    scale_xy: tuple[Positive, ...] = (1.0,)  # of all levels, or of each
    variances: Sizes = (1.0, 1.0)  # of centers and sizes

    if TYPE_CHECKING:  # frozen models have one

        def __hash__(self) -> int: ...


def _ssd_anchors(size: float, scales: Sequence[float], ratios: Sequence[int]) -> list[list[Sizes]]:
    """(width, height) by level: a square, one between it and the next one's, the ratio 2 both ways, then 3."""
    levels = []
    for (scale, larger), count in zip(pairwise(scales), ratios, strict=True):
        factors = [factor for ratio in (2, 3)[:count] for factor in (ratio**0.5, ratio**-0.5)]
        sides = [(scale, scale), 2 * (math.sqrt(scale * larger),), *((scale * f, scale / f) for f in factors)]
        levels.append([(size * min(width, 1), size * min(height, 1)) for width, height in sides])
    return levels


def _retina_anchors() -> list[list[Sizes]]:
    """(width, height) at each level, whole pixels: height / width of 1/2, 1, 2, three sizes each."""
    levels = [[int(side * 2 ** (third / 3)) for third in range(3)] for side in (32, 64, 128, 256, 512)]
    roots = 0.5**0.5, 1, 2**0.5
    return [[(2 * round(side / r / 2), 2 * round(side * r / 2)) for r in roots for side in each] for each in levels]


def _levels(numbers: str, per_level: int = 3) -> list[list[Sizes]]:
    """Anchors by level, from "width,height" of each, the finest level's first."""
    pairs = [(float(width), float(height)) for width, height in (pair.split(",") for pair in numbers.split())]
    return [pairs[first : first + per_level] for first in range(0, len(pairs), per_level)]


_YOLO2 = {"anchors": _levels("18.327,21.676 59.983,66.001 106.83,175.179 252.25,112.889 312.657,293.385", 5)}
_YOLO3 = {"anchors": _levels("10,13 16,30 33,23 30,61 62,45 59,119 116,90 156,198 373,326")}
_YOLO4 = {"anchors": _levels("12,16 19,36 40,28 36,75 76,55 72,146 142,110 192,243 459,401")}
_TINY = {"anchors": _levels("23,27 37,58 81,82 81,82 135,169 344,319")}
_GFL = {"formula": "distances", "scores": "probabilities", "columns": ("scores", "boxes"), "bins": 8}
_SSD = {"formula": "deltas", "scores": "softmax", "background": "first", "variances": (0.1, 0.2)}
_SSD300 = {"anchors": _ssd_anchors(300, (0.07, 0.15, 0.33, 0.51, 0.69, 0.87, 1.05), (1, 2, 2, 2, 1, 1))}
_LITE = {"anchors": _ssd_anchors(320, (0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.0), 6 * (2,))}
_THREE, _FOUR, _FIVE = ({"strides": (8, 16, 32, 64, 128)[:count]} for count in (3, 4, 5))
_FLOOR = {**_FIVE, "center": 0, "floor": True}
_FCOS = {**_FIVE, "formula": "distances", "exponent": 0.5}
HEADS: dict[str, dict[str, Any]] = {
    "boxes": {},  # decoded: boxes in pixels, then logits
    "ultralytics": {"boxes": "cxcywh", "scores": "probabilities"},  # YOLOv5 to 12 as exported; end to end, RT-DETR, too
    "detr": {"boxes": "cxcywh", "unit": "share", "background": "last"},
    "yolov2": {"formula": "grid", "scores": "softmax", **_YOLO2},
    "yolov3": {"formula": "grid", **_YOLO3},
    "yolov3-tiny": {"formula": "grid", **_TINY},
    "yolov4": {"formula": "grid", "scale_xy": (1.2, 1.1, 1.05), **_YOLO4},
    "yolov4-tiny": {"formula": "grid", "scale_xy": (1.05,), **_TINY},
    "yolov5": {"formula": "squares", "scale_xy": (2,), **_YOLO3},
    "yolov7": {"formula": "squares", "scale_xy": (2,), **_YOLO4},
    "yolo-fastest": {"formula": "grid", "anchors": _levels("12,18 37,49 52,132 115,73 119,199 242,238")},
    "yolox": {**_THREE, "formula": "deltas", "scores": "probabilities", "center": 0},
    "yolov8-raw": {**_THREE, "formula": "distances", "bins": 16},
    "nanodet": {**_THREE, **_GFL},
    "nanodet-plus": {**_FOUR, **_GFL, "center": 0},
    "picodet": {**_FOUR, **_GFL},
    "fcos": _FCOS,
    "torchvision-fcos": {**_FCOS, **_FLOOR},
    "retinanet": {**_FLOOR, "formula": "deltas", "anchors": _retina_anchors()},
    "ssd300": {**_SSD, **_SSD300, "strides": (8, 16, 32, 64, 100, 300)},
    "ssdlite320": {**_SSD, **_LITE, "strides": (16, 32, 64, 320 / 3, 160, 320)},
}


def head_of(described: str | Mapping[str, Any], source: str) -> Head:
    """The head that a name, or a table with a name and the values that differ from its row, describes."""
    table = described if isinstance(described, Mapping) else {"name": described}
    if (name := str(table.get("name"))) not in HEADS:
        raise Refused(f'the name of a head as "head" in {source}', f"{name!r}"[:80], spelling_hint(name, HEADS))
    return validate_model(Head, {**HEADS[name], **table}, f'"head" in {source}')
