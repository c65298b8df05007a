"""Decode the outputs of detectors' usual heads into candidates: boxes in pixels, and logits.

In: a network's outputs, together or by level: N×A×C, N×C×A, N×C×H×W, N×H×W×C, or anchors in their own dimension; and
its head. Without a head the outputs' shapes decide, and the first outputs' values on boxes that are decoded already; a
warning says how. Out: candidates N×A×(4+K), differentiable. Left out on purpose: suppression (detector.py); clipping to
the picture; masks, keypoints, rotated boxes.
"""

import json
import math
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
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
MAX_SHARE = 2.0  # of the input's side; boxes beyond are pixels
MAX_MISFIT = 0.15  # of boxes that are taken for corners: right ones have 0.015 at most, others 0.2 and more
MIN_GAIN = 0.02  # in misfit, from which another order of boxes is taken
MANY_BOXES = 64  # from which candidates are taken to lie all over a picture
GRID_BOXES = 16  # from which candidates are taken for those of a grid's cells, row by row
# tried in this order for outputs of an unknown head; grids of anchors differ in their values, not in shapes
_GUESSES = "ultralytics nanodet nanodet-plus yolov8-raw retinanet ssd300 ssdlite320 fcos torchvision-fcos detr".split()
_ORDERS = "xyxy", "cxcywh", "xywh", "yxyx"
_WORDS = {"boxes": "box|reg|loc|dis|delta", "objectness": "obj|cent|ctr", "scores": "score|cls|class|conf|logit|prob"}
_MOST_SUPPRESSED = 1000  # rows that networks keep of their candidates, which are more
_SURE = 0.05  # scores below are of rows that only fill a table
OutputShape = tuple[int, ...]  # without the number of pictures
Shapes = tuple[OutputShape, ...]
OutputLayout = tuple[OutputShape, tuple[str, ...], OutputShape]  # a table's order of dimensions, columns, numbers


@dataclass(eq=False)
class HeadDecoder:
    """Turns outputs for squares of `input_px` into candidates N×A×(4+`labels`); guesses a head that is not given."""

    network: str  # its name
    labels: int
    input_px: int
    head: Head | None = None

    def __call__(self, names: Sequence[str], *outputs: Tensor) -> Tensor:
        """Decode the outputs; their names help where their shapes are alike."""
        shapes = _shapes(outputs)
        head = self.head or _guess(self, tuple(names), shapes)
        if any(each.is_meta for each in outputs):  # a dry run, in which torch would compute the formulas in Python
            *_, rows = _plan(self, head, tuple(names), shapes)
            return torch.empty(len(outputs[0]), rows, 4 + self.labels, device="meta")
        if self.head is None:
            self.head = head = _fitted_head(self, head, names, outputs)
        (values, objectness, scores, numbers), cells = self.parts(head, names, outputs)
        if head.scores == "probabilities" and bool(((scores < -1e-3) | (scores > 1 + 1e-3)).any()):
            got = f"scores from {float(scores.min()):.3g} to {float(scores.max()):.3g} from the network {self.network}"
            do = f'write "head": {{"name": "{head.name}", "scores": "logits"}} into its JSON'
            raise Refused(f"scores in 0 to 1 from the head {head.name}", got, do)
        values = values * self.input_px if head.unit == "share" else values
        if numbers is not None:  # YOLO's rows have corners in pixels, RT-DETR's centers and sizes in shares
            boxes = values if head.unit == "pixels" or head.boxes == "xyxy" else _boxes(values, [], head)
            return spread_labels(boxes, numbers[..., 0], scores[..., 0], self.labels)
        boxes = _boxes(values, [torch.as_tensor(each).to(values) for each in cells], head)
        return torch.cat([boxes, _logits(scores, objectness, head, self.labels)], -1)

    def parts(self, head: Head, names: Sequence[str], outputs: Sequence[Tensor]) -> tuple[list, list[np.ndarray]]:
        """Boxes' values, objectness, scores, numbers of labels, each N×A×C or None; and the cells (see `_cells`)."""
        layouts, cells, _ = _plan(self, head, tuple(names), _shapes(outputs))
        pairs = zip(outputs, layouts, strict=True)
        tables = [(each.permute(like[0]).reshape(len(each), -1, sum(like[2])), *like[1:]) for each, like in pairs]
        found: dict[str, list[Tensor]] = {"boxes": [], "objectness": [], "scores": [], "labels": []}
        for table, roles, widths in sorted(tables, key=lambda each: -each[0].shape[1]):
            for role, part in zip(roles, table.split(widths, -1), strict=True):
                found[role].append(part)
        return [torch.cat(each, 1) if each else None for each in found.values()], cells

    def refusal(self, expected: str, shapes: Shapes, do: str = "") -> Refused:
        """The error for outputs of these shapes."""
        do = do or f'write "head" into its JSON, a name or a table with a name and what differs: {", ".join(HEADS)}'
        return Refused(expected, f"{_shapes_text(shapes)} from the network {self.network}", do)


def spread_labels(boxes: Tensor, labels: Tensor, scores: Tensor, count: int) -> Tensor:
    """Return candidates N×M×(4+`count`) of boxes N×M×4 with one label each, which is ignored below 0; refused
    are labels of `count` and more.
    """
    if bool(((labels >= count) & (scores > _SURE)).any()):
        do = 'list a name for each of its numbers, and "background" first if it counts from 1'
        raise Refused(f"labels from 0 to {count - 1}", f"{int(labels.max())} from the network", do)
    score = scores.clamp(1e-6, 1 - 1e-6).logit().masked_fill((labels < 0) | (labels >= count), NO_BOX_LOGIT)[..., None]
    logits = scores.new_full((*scores.shape, count), NO_BOX_LOGIT)
    return torch.cat([boxes, logits.scatter(-1, labels.long().clamp(0, count - 1)[..., None], score)], -1)


def _shapes(outputs: Sequence[Tensor]) -> Shapes:
    return tuple(tuple(each.shape[1:]) for each in outputs)


def _shapes_text(shapes: Shapes) -> str:
    return " and ".join("N×" + "×".join(map(str, shape)) for shape in shapes)


@lru_cache(maxsize=64)
def _plan(
    decoder: HeadDecoder, head: Head, names: tuple[str, ...], shapes: Shapes
) -> tuple[list[OutputLayout], list[np.ndarray], int]:
    """Each output's layout, the cells (see `_cells`), and the number of boxes."""
    layouts = _layouts(decoder, head, names, shapes)
    rows, grids = {"boxes": 0, "scores": 0}, set[int]()
    for shape, (order, roles, widths) in zip(shapes, layouts, strict=True):
        for role in roles:
            rows[role] = rows.get(role, 0) + math.prod(shape) // sum(widths)
        grids |= {shape[order[1] - 1]} if len(shape) > 2 and "boxes" in roles else set()
    if len({*rows.values()}) > 1:
        raise decoder.refusal(f"as many boxes as scores from the head {head.name} (found {rows})", shapes)
    if head.formula == "none":
        return layouts, [], rows["boxes"]
    strides = head.strides or tuple(decoder.input_px / side for side in sorted(grids, reverse=True))
    sides = tuple(math.ceil(decoder.input_px / stride - 1e-6) for stride in strides)
    anchors = [len(level) for level in head.anchors] or [1] * len(sides)
    count = sum(side**2 * each for side, each in zip(sides, anchors, strict=False))
    if rows["boxes"] != count or len(anchors) != len(sides):
        raise decoder.refusal(f"boxes of the head {head.name} on {len(anchors)} levels, cells a side: {sides}", shapes)
    return layouts, _cells(head, sides, strides, decoder.input_px), rows["boxes"]


def _guess(decoder: HeadDecoder, names: tuple[str, ...], shapes: Shapes) -> Head:
    """The head that the shapes fit."""
    is_table, by_level = len(shapes) == 1 and len(shapes[0]) == 2, len(shapes[0]) > 2
    if is_table and shapes[0][1] == 4 + decoder.labels:
        return head_of("boxes", "HEADS")
    fitting = {"ultralytics": is_table, "fcos": by_level, "torchvision-fcos": not by_level, "detr": not is_table}
    for name in (each for each in _GUESSES if fitting.get(each, True)):
        with suppress(Refused):
            head = head_of(name, "HEADS")
            _plan(decoder, head, names, shapes)
            return head
    raise decoder.refusal(f"the outputs of a detector's head for {decoder.labels} labels", shapes)


def _fitted_head(decoder: HeadDecoder, head: Head, names: Sequence[str], outputs: Sequence[Tensor]) -> Head:
    """The guessed head; for decoded boxes with the order, unit and scores that fit the outputs best. Warns unless it is
    the head that `Detector` takes.
    """
    shapes, outputs = _shapes(outputs), [each.detach() for each in outputs]
    fitted = _fitted_values(decoder, head, names, outputs) if head.formula == "none" else head
    if fitted != head_of("boxes", "HEADS"):
        differs = {key: value for key, value in fitted.model_dump().items() if value != getattr(head, key)}
        words = json.dumps({"name": head.name, **differs} if differs else head.name)
        text = f"{decoder.network} gives {_shapes_text(shapes)}, read as the head {words}"
        warnings.warn(f'{text}: write "head" into its JSON, this or another', stacklevel=4)
    return fitted


def _fitted_values(decoder: HeadDecoder, head: Head, names: Sequence[str], outputs: Sequence[Tensor]) -> Head:
    """Return the head with the columns, unit and order in which its decoded boxes fit the square, or else unchanged."""
    tried: list[tuple[float, Head]] = []
    for columns in (head.columns, ("scores", "boxes"))[: 1 + (len(outputs) == 1)]:
        try:
            parts, _ = decoder.parts(head.model_copy(update={"columns": columns}), names, outputs)
        except Refused:  # a table without room for an objectness
            continue
        values, objectness, scores, numbers = parts
        unit = ("share", decoder.input_px) if float(values.abs().max()) <= MAX_SHARE else ("pixels", 1)
        fits = {"columns": columns, "unit": unit[0]}
        if numbers is not None:
            if not (0 <= float(scores.min()) and float(scores.max()) <= 1):
                raise decoder.refusal("rows of a box, a score and a label's number", _shapes(outputs))
            orders = (head.boxes, "xyxy")[: 1 + (unit[0] == "share")]
            rows = [head.model_copy(update=fits | {"boxes": order}) for order in orders]
            return min(rows, key=lambda each: _misfit(_boxes(values * unit[1], [], each), decoder.input_px))
        fits |= _fitted_scores(decoder, scores, objectness, outputs)
        rows = values[(values != 0).any(-1)]
        are_corners = len(rows) >= MANY_BOXES and float((rows[:, 2:] > rows[:, :2]).all(1).float().mean()) > 0.98
        for order in ("xyxy", "yxyx") if are_corners else dict.fromkeys((head.boxes, *_ORDERS)):
            fitted = head.model_copy(update=fits | {"boxes": order})
            tried.append((_misfit(_boxes(values * unit[1], [], fitted), decoder.input_px), fitted))
    least = min(misfit for misfit, _ in tried)
    return next(fitted for misfit, fitted in tried if misfit <= least + MIN_GAIN) if least < MAX_MISFIT else head


def _fitted_scores(
    decoder: HeadDecoder, scores: Tensor, objectness: Tensor | None, outputs: Sequence[Tensor]
) -> dict[str, str]:
    """Tell if scores N×A×C are logits or probabilities, and if a background's (mostly the largest) is first or last."""
    joined = scores if objectness is None else torch.cat([objectness, scores], -1)
    is_share = bool(((joined > -1e-3) & (joined < 1 + 1e-3)).all())
    adds_up = is_share and bool(((joined.sum(-1) - 1).abs() < 1e-2).all())
    if scores.shape[-1] > decoder.labels or (objectness is not None and adds_up):
        where = "first" if int(joined.mean((0, 1)).argmax()) == 0 else "last"
        return {"scores": "probabilities" if adds_up else "logits", "background": where}
    if objectness is not None and not is_share and len(outputs) == 1:
        do = 'write "head": {"name": "ultralytics", "scores": "logits"} into its JSON if it is an objectness, or '
        do += '{"name": "boxes", "background": "last"} (or "first") for a softmax with a background'
        raise decoder.refusal(f"a head that says what stands beside {decoder.labels} scores", _shapes(outputs), do)
    return {"scores": "probabilities" if is_share else "logits"}


def _misfit(boxes: Tensor, input_px: int) -> float:
    """How little boxes N×A×4 look like corners in a square: what share is empty, how far they reach out of it, how
    little of it their centers cover, how far off its middle, and whether they run down its columns.
    """
    found = boxes[(boxes != 0).any(-1)] / input_px  # rows of zeros fill up a table
    if not len(found):
        return 1.0
    first, last = found.split(2, -1)
    outside = ((-first).clamp_min(0) + (last - 1).clamp_min(0)).mean()
    low, high = centers_range(found)
    gap = (0.5 - (high - low).min()).clamp_min(0) + ((low + high - 1) / 2).abs().max()
    return float((last <= first).any(-1).float().mean() + outside + gap) + 0.2 * runs_down_columns(boxes)


def centers_range(boxes: Tensor) -> Tensor:
    """Return the 5 % and 95 % points (x, y) of the centers of boxes M×4, as 2×2."""
    centers = boxes[:: 1 + len(boxes) // 100_000].unflatten(-1, (2, 2)).mean(-2)
    return torch.quantile(centers, torch.tensor([0.05, 0.95]).to(centers), 0)


def runs_down_columns(boxes: Tensor) -> bool:
    """True if boxes N×A×4 change faster along the second coordinate, as a grid's do whose x and y are swapped."""
    steps = boxes.diff(dim=1).abs().mean((0, 1))
    return boxes.shape[1] >= GRID_BOXES and bool(steps[1] > 3 * steps[0])


def _layouts(decoder: HeadDecoder, head: Head, names: Sequence[str], shapes: Shapes) -> list[OutputLayout]:
    """Each output's layout: the one that its shape allows; of several, the one that others lack or its name states."""
    options = [_options(head, decoder.labels, shape, len(shapes)) for shape in shapes]
    if not all(options):
        raise decoder.refusal(f"outputs of the head {head.name} for {decoder.labels} labels", shapes)
    taken = {role for found in options if len(found) == 1 for role in found[0][1]}
    for number, (found, name) in enumerate(zip(options, head.outputs or names, strict=False)):
        if len(found) > 1:
            if any("labels" in each[1] for each in found):  # of what a network has suppressed itself there are few rows
                found = [each for each in found if ("labels" in each[1]) == (shapes[number][0] <= _MOST_SUPPRESSED)]
            rest = found if head.outputs else [each for each in found if not taken & {*each[1]}]
            if len(rest) > 1:
                rest = [each for each in rest if any(re.search(_WORDS[role], name, re.I) for role in each[1])]
            options[number] = rest
    if any(len(found) != 1 for found in options):
        do = f'say what each holds: "head": {{"name": "{head.name}", "outputs": ["boxes", "scores"]}}'
        raise decoder.refusal("boxes and scores that differ in shape or name", shapes, do)
    return [found[0] for found in options]


def _options(head: Head, labels: int, shape: OutputShape, count: int) -> list[OutputLayout]:
    """The layouts that an output of this shape, of `count` outputs, may have."""
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
    has_sure = head.exponent < 1 or (head.formula == "none" and count > 2)  # an objectness of its own
    alone = (*two, *(each for each in other if each[0] != "objectness"), *[("objectness", 1)] * has_sure)
    parts = [[each] for each in alone if count > 1]
    for order in orders if shape else ():
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
