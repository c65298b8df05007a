"""Decode the outputs of detectors' usual heads into candidates: boxes in pixels, and logits.

In: a network's outputs, of all levels or each: N×A×C, N×C×A, N×C×H×W, N×H×W×C, or anchors in a dimension of their
own; and its head, or none: then shapes decide, which a warning says. Out: candidates N×A×(4+K), differentiable.
Left out on purpose: suppression (detector.py); clipping to the picture; masks, keypoints, boxes that are turned.
"""

import math
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from patchproof.base.errors import Refused
from patchproof.classifier.heads import HEADS, Head, head_of
from patchproof.classifier.network import NO_BOX_LOGIT

LEAST_SCORE, MOST_LOG = 1e-12, -1e-7  # ends of float32 between which a score has a logit with a gradient
MAX_EXPONENT = 10.0  # of a side beside its anchor's
MAX_QUERIES = 1000  # of a set of boxes; anchors are more
# tried in this order for outputs of an unknown head; grids of anchors differ in their values, not in shapes
_GUESSES = "ultralytics nanodet nanodet-plus yolov8-raw retinanet ssd300 ssdlite320 fcos torchvision-fcos detr".split()
_WORDS = {"boxes": "box|reg|loc|dis|delta", "objectness": "obj|cent|ctr", "scores": "score|cls|class|conf|logit|prob"}
OutputShape = tuple[int, ...]  # without the number of pictures
Shapes = tuple[OutputShape, ...]
OutputLayout = tuple[OutputShape, tuple[str, ...], OutputShape]  # a table's order of dimensions, columns, numbers


@dataclass(frozen=True)
class HeadDecoder:
    """Turns the outputs of a network for squares of `input_px` into candidates N×A×(4+K) of K = `labels`."""

    network: str  # its name
    labels: int
    input_px: int
    head: Head | None = None

    def __call__(self, names: Sequence[str], *outputs: Tensor) -> Tensor:
        """Decode the outputs; their names help where their shapes are alike."""
        head, layouts, cells = _plan(self, tuple(names), tuple(tuple(each.shape[1:]) for each in outputs))
        pairs = zip(outputs, layouts, strict=True)
        tables = [(each.permute(like[0]).reshape(len(each), -1, sum(like[2])), *like[1:]) for each, like in pairs]
        if any(each.is_meta for each in outputs):  # a dry run, in which torch would compute the formulas in Python
            rows = sum(table.shape[1] for table, roles, _ in tables if "boxes" in roles)
            return torch.empty(len(outputs[0]), rows, 4 + self.labels, device="meta")
        parts: dict[str, list[Tensor]] = {"boxes": [], "objectness": [], "scores": [], "labels": []}
        for table, roles, widths in sorted(tables, key=lambda each: -each[0].shape[1]):
            for role, part in zip(roles, table.split(widths, -1), strict=True):
                parts[role].append(part)
        values, objectness, scores, numbers = (torch.cat(each, 1) if each else None for each in parts.values())
        assert values is not None and scores is not None  # as _plan has found
        if head.scores == "probabilities" and bool(((scores < -1e-3) | (scores > 1 + 1e-3)).any()):
            got = f"scores from {float(scores.min()):.3g} to {float(scores.max()):.3g} from the network {self.network}"
            do = f'write "head": {{"name": "{head.name}", "scores": "logits"}} into its JSON'
            raise Refused(f"scores in 0 to 1 from the head {head.name}", got, do)
        if numbers is not None:  # with boxes as corners
            return spread_labels(values, numbers[..., 0], scores[..., 0], self.labels)
        boxes = _boxes(values, [torch.as_tensor(each).to(values) for each in cells], head)
        boxes = boxes * self.input_px if head.unit == "share" else boxes
        return torch.cat([boxes, _logits(scores, objectness, head, self.labels)], -1)

    def refusal(self, expected: str, shapes: Shapes, do: str = "") -> Refused:
        """The error for outputs of these shapes."""
        do = do or f'write "head" into its JSON, a name or a table with a name and what differs: {", ".join(HEADS)}'
        return Refused(expected, f"{_shapes_text(shapes)} from the network {self.network}", do)


def spread_labels(boxes: Tensor, labels: Tensor, scores: Tensor, count: int) -> Tensor:
    """Candidates N×M×(4+`count`) from boxes N×M×4 of one label each; where that is not in 0 to `count`, of none."""
    score = scores.clamp(1e-6, 1 - 1e-6).logit().masked_fill((labels < 0) | (labels >= count), NO_BOX_LOGIT)[..., None]
    logits = scores.new_full((*scores.shape, count), NO_BOX_LOGIT)
    return torch.cat([boxes, logits.scatter(-1, labels.long().clamp(0, count - 1)[..., None], score)], -1)


def _shapes_text(shapes: Shapes) -> str:
    return " and ".join("N×" + "×".join(map(str, shape)) for shape in shapes)


@lru_cache(maxsize=64)
def _plan(decoder: HeadDecoder, names: tuple, shapes: Shapes) -> tuple[Head, list[OutputLayout], list[np.ndarray]]:
    """The head, each output's layout, and the cells (see `_cells`)."""
    head = decoder.head or _guess(decoder, names, shapes)
    layouts = _layouts(decoder, head, names, shapes)
    rows, grids = {"boxes": 0, "scores": 0}, set[int]()
    for shape, (order, roles, widths) in zip(shapes, layouts, strict=True):
        for role in roles:
            rows[role] = rows.get(role, 0) + math.prod(shape) // sum(widths)
        grids |= {shape[order[1] - 1]} if len(shape) > 2 and "boxes" in roles else set()
    if len({*rows.values()}) > 1:
        raise decoder.refusal(f"as many boxes as scores from the head {head.name} (found {rows})", shapes)
    if head.formula == "none":
        return head, layouts, []
    strides = head.strides or tuple(decoder.input_px / side for side in sorted(grids, reverse=True))
    sides = tuple(math.ceil(decoder.input_px / stride - 1e-6) for stride in strides)
    anchors = [len(level) for level in head.anchors] or [1] * len(sides)
    count = sum(side**2 * each for side, each in zip(sides, anchors, strict=False))
    if rows["boxes"] != count or len(anchors) != len(sides):
        raise decoder.refusal(f"boxes of the head {head.name} on {len(anchors)} levels, cells a side: {sides}", shapes)
    return head, layouts, _cells(head, sides, strides, decoder.input_px)


def _guess(decoder: HeadDecoder, names: tuple[str, ...], shapes: Shapes) -> Head:
    """The head that the shapes fit, said in a warning unless it is that of decoded boxes."""
    is_table, by_level = len(shapes) == 1 and len(shapes[0]) == 2, len(shapes[0]) > 2
    if is_table and shapes[0][1] == 4 + decoder.labels:
        return head_of("boxes", "HEADS")
    is_set = len(shapes) == 2 and max(map(max, shapes)) <= MAX_QUERIES
    fitting = {"ultralytics": is_table, "fcos": by_level, "torchvision-fcos": not by_level, "detr": is_set}
    for name in (each for each in _GUESSES if fitting.get(each, True)):
        with suppress(Refused):
            head, *_ = _plan(replace(decoder, head=head_of(name, "HEADS")), names, shapes)
            text = f'{decoder.network} gives {_shapes_text(shapes)}, read as the head "{name}"'
            warnings.warn(f'{text}: write "head" into its JSON, this or another', stacklevel=2)
            return head
    raise decoder.refusal(f"the outputs of a detector's head for {decoder.labels} labels", shapes)


def _layouts(decoder: HeadDecoder, head: Head, names: Sequence[str], shapes: Shapes) -> list[OutputLayout]:
    """Each output's layout: the one that its shape allows; of several, what no other output holds, or its name says."""
    options = [_options(head, decoder.labels, shape, len(shapes) == 1) for shape in shapes]
    if not all(options):
        raise decoder.refusal(f"outputs of the head {head.name} for {decoder.labels} labels", shapes)
    taken = {role for found in options if len(found) == 1 for role in found[0][1]}
    for number, (found, name) in enumerate(zip(options, head.outputs or names, strict=False)):
        if len(found) > 1:
            rest = found if head.outputs else [each for each in found if not taken & {*each[1]}]
            said = [each for each in rest if any(re.search(_WORDS[role], name, re.I) for role in each[1])]
            options[number] = rest if len(rest) == 1 else said
    if any(len(found) != 1 for found in options):
        do = f'say what each holds: "head": {{"name": "{head.name}", "outputs": ["boxes", "scores"]}}'
        raise decoder.refusal("boxes and scores that differ in shape or name", shapes, do)
    return [found[0] for found in options]


def _options(head: Head, labels: int, shape: OutputShape, is_alone: bool) -> list[OutputLayout]:
    """The layouts that an output of this shape may have."""
    per_cell, last = {len(level) for level in head.anchors} or {1}, tuple(range(len(shape) + 1))
    orders: list[OutputShape] = [last, (0, 2, 1)] if len(shape) == 2 else [last]
    if len(shape) == 3 and shape[1] == shape[2]:
        orders = [(0, 2, 3, 1)]
    elif len(shape) == 4 and shape[0] in per_cell:
        orders = [(0, 2, 3, 1, 4)]
    width = {"boxes": 4 * max(head.bins, 1), "objectness": 1, "scores": labels}
    two = [(role, width[role]) for role in head.columns if role != "objectness"]
    wide = [(role, count + (role == "scores")) for role, count in two]
    other = wide if head.background else [(role, width[role]) for role in head.columns]
    parts = [] if is_alone else [[each] for each in (*two, *other) if each[0] != "objectness" or head.exponent < 1]
    for order in orders:
        is_row = head.name == "ultralytics" and order != (0, 2, 1)  # suppressed by the network itself
        tables = [[("boxes", 4), ("scores", 1), ("labels", 1)] if is_row else two, other, *parts]
        sizes = {shape[order[-1] - 1] / count for count in (per_cell if len(shape) == 3 else {1})}
        if fitting := [table for table in tables if sum(count for _, count in table) in sizes]:
            columns = (tuple(zip(*each, strict=True)) for each in fitting)
            return list(dict.fromkeys((order, roles, widths) for roles, widths in columns))
    return []


def _cells(head: Head, sides: OutputShape, strides: Sequence[float], input_px: int) -> list[np.ndarray]:
    """Each candidate's cell center and anchor, A×2 pixels, and its level's stride and scale, A×1, finest first."""
    levels = []
    for number, (side, stride) in enumerate(zip(sides, strides, strict=True)):
        step = input_px // side if head.floor else stride
        sizes = np.array(head.anchors[number] if head.anchors else [(step, step)])
        line = (np.arange(side) + head.center) * step
        centers = np.stack([np.tile(line, side), np.repeat(line, side)], 1).repeat(len(sizes), 0)
        scale, ones = head.scale_xy[min(number, len(head.scale_xy) - 1)], np.ones((len(centers), 1))
        levels.append((centers, np.tile(sizes, (side * side, 1)), step * ones, scale * ones))
    return [np.concatenate(parts).astype(np.float32) for parts in zip(*levels, strict=True)]


def _boxes(values: Tensor, cells: list[Tensor], head: Head) -> Tensor:
    """Boxes (left, top, right, bottom) from the four values, or distributions, of each candidate."""
    if head.bins:
        shares = values.unflatten(-1, (4, head.bins)).softmax(-1)
        values = (shares * torch.arange(head.bins, device=values.device)).sum(-1)
    first, second = (values[..., [1, 0, 3, 2]] if head.boxes == "yxyx" else values).split(2, -1)
    if head.formula == "none":
        if head.boxes == "cxcywh":
            return torch.cat([first - second / 2, first + second / 2], -1)
        return torch.cat([first, first + second if head.boxes == "xywh" else second], -1)
    centers, anchors, strides, scales = cells
    if head.formula == "distances":  # from a cell's center to the four sides, in strides: FCOS, GFL
        return torch.cat([centers - first * strides, centers + second * strides], -1)
    if head.formula == "deltas":  # shifts in anchors' sizes, logarithms of sides: SSD, RetinaNet, YOLOX
        centers = centers + head.variances[0] * first * anchors
        second = head.variances[1] * second
    else:  # within a cell, or near it: YOLO with anchors
        centers = centers + (first.sigmoid() - 0.5) * scales * strides
    factors = (2 * second.sigmoid()) ** 2 if head.formula == "squares" else second.clamp_max(MAX_EXPONENT).exp()
    return torch.cat([centers - anchors * factors / 2, centers + anchors * factors / 2], -1)


def _logits(scores: Tensor, objectness: Tensor | None, head: Head, labels: int) -> Tensor:
    """The logits of labels' scores N×A×K, or of score · objectness."""
    has_background, is_share = scores.shape[-1] > labels, head.scores == "probabilities"
    if head.scores == "logits" and not has_background and objectness is None:
        return scores
    log = (lambda values: values.clamp_min(LEAST_SCORE).log()) if is_share else logsigmoid
    by_softmax = not is_share and (has_background or head.scores == "softmax")
    result = scores.log_softmax(-1) if by_softmax else log(scores)
    if has_background:
        result = result[..., 1:] if head.background == "first" else result[..., :-1]
    if objectness is not None:
        result = head.exponent * (result + log(objectness))
    result = result.clamp_max(MOST_LOG)
    return result - (-torch.expm1(result)).log()
