"""Find by a network's outputs that they are no logits, or no boxes (left, top, right, bottom) in pixels of the square.

In: a classifier, the check's pictures, and its outputs for them. Out: nothing; refused where the outputs can be nothing
else, a warning where they look like it. A Sigmoid or Softmax is known by its name where autograd shows it at the end,
and by its behavior: pictures far outside of [0, 1] drive it to its ends, and logits beyond them.
"""

import re
import warnings
from typing import Any

import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.classifier.head_decoder import MANY_BOXES, centers_range, runs_down_columns
from patchproof.classifier.network import NO_BOX_LOGIT, Classifier

FAR = 1e3  # by which pictures are multiplied to drive scores to their ends
NEAR = 1 / 128  # of the range: scores of 8 bits end at 255 / 256
TOPS = (1, 100, 255)  # of probabilities, percent and 8 bits
MANY_SCORES = 300  # in a detector's candidates; of so many logits, those of the background are below 0
_SQUASHED = ("Sigmoid", "Hardsigmoid", "Softmax")
# operations that move values, scale them or choose among them, as autograd names them
_MOVED = """View UnsafeView ReshapeAlias AsStrided Alias Clone ToCopy Slice Select Split SplitWithSizes Unbind Index
IndexSelect Squeeze Unsqueeze Transpose T Permute Expand Repeat Cat Stack Mul Div""".split()


def check_shape(output: Any, classifier: Classifier) -> None:
    """Refuse outputs for three pictures that are not 3×K, or not a detector's 3×A×(4+K)."""
    classes, is_tensor = len(classifier.labels), isinstance(output, Tensor)
    shape = tuple(output.shape) if is_tensor else ()
    if classifier.LOOKS_AT_BOXES:
        if len(shape) == 3 and shape[0] == 3 and shape[1] > 0 and shape[2] == 4 + classes:
            return
        expected = f"a detector's candidates 3×A×{4 + classes}: left, top, right, bottom in pixels, {classes} logits"
        do = 'write "head" into its JSON, or decode its heads inside of the network'
    else:
        if shape == (3, classes):
            return
        expected = f"{classes} logits for each picture, one a label"
        do = "give it as many labels as it has outputs, a background's among them"
        if not is_tensor or len(shape) > 2:
            do = 'if it is a detector, write "kind": "detector" into its JSON, and "head" where its boxes are raw'
            if classifier.name.startswith(("module:", "python:")):
                do = 'return its logits alone, as a tensor, or give it kind = "detector", and a head for raw boxes'
    got = f"{shape if is_tensor else type(output).__name__} for 3 pictures from the network {classifier.name}"
    raise Refused(expected, got, do)


def check_values(classifier: Classifier, photos: Tensor, output: Tensor) -> None:
    """Refuse boxes that are not corners in pixels, and scores 3×K or 3×A×K that are probabilities, percent or 8-bit."""
    if classifier.LOOKS_AT_BOXES:
        _check_boxes(classifier, output)
    scores = output[..., 4:] if classifier.LOOKS_AT_BOXES else output
    name, do = f"the network {classifier.name}", "leave its last Softmax or Sigmoid out"
    do += ', or write "head": {"name": "boxes", "scores": "probabilities"}' if classifier.LOOKS_AT_BOXES else ""
    if bool((scores == scores.round()).all()) and bool((scores != scores[:1]).any()):
        got = f"whole numbers from {float(scores.min()):g} to {float(scores.max()):g} from {name}"
        raise Refused("logits, which are fractions", got, f"export it without quantization, and {do}")
    if scores.min() < -1e-4 or scores.max() > TOPS[-1] + 1:
        return
    far = _far_scores(classifier, photos)
    low, high = (float(end) for end in torch.cat([scores.flatten(), far]).aminmax())
    top = next((top for top in TOPS if high <= top * (1 + 1e-4)), None)
    if top is None or low < -1e-4:
        return
    ends = (far < NEAR * top) | (far > (1 - NEAR) * top)
    sums = not classifier.LOOKS_AT_BOXES and bool(((scores.sum(1) - top).abs() < 1e-3 * top).all())
    many = classifier.LOOKS_AT_BOXES and scores.numel() >= MANY_SCORES
    at_ends = bool((far > (1 - NEAR) * top).any() and ends.all())
    if sums or many or at_ends or _ends_squashed(classifier.network(photos.clone().requires_grad_()).grad_fn, {}):
        seen = f"rows that sum to {top}" if sums else f"all from 0 to {top}, also for pictures outside of [0, 1]"
        raise Refused("logits", f"probabilities from {name} ({seen})", do)
    if top == 1:
        seen = f"only outputs from {low:.2g} to {high:.2g}"
        warnings.warn(f"{name} gives {seen}: if they are probabilities, {do}", stacklevel=3)


def _far_scores(classifier: Classifier, photos: Tensor) -> Tensor:
    """The finite scores for pictures far outside of [0, 1]; none from a network that refuses such pictures."""
    try:
        with torch.no_grad():
            far = torch.cat([classifier.network(sign * FAR * photos) for sign in (1, -1)])
    except Exception:  # the network is the user's program and may raise anything
        return photos.new_empty(0)
    far = far[..., 4:] if classifier.LOOKS_AT_BOXES else far
    return far[torch.isfinite(far)]


def _ends_squashed(node: Any, known: dict[Any, bool]) -> bool:
    """True if the values behind an autograd node are those of a Sigmoid or Softmax, moved or scaled."""
    if node is None or len(known) > 500:  # a limit for files made to do harm
        return False
    if node not in known:
        name, known[node] = re.sub(r"Backward\d*$", "", node.name()), False
        inner = [_ends_squashed(each, known) for each, _ in node.next_functions if each and name in _MOVED]
        known[node] = name in _SQUASHED or (any(inner) if name != "Mul" else bool(inner) and all(inner))
    return known[node]


def _check_boxes(classifier: Classifier, candidates: Tensor) -> None:
    """Refuse boxes, among candidates 3×A×(4+K), that are in 0 to 1, or whose corners are no corners."""
    name, sides = f"the network {classifier.name}", candidates[..., :4]
    found = (candidates[..., 4:].amax(-1) > NO_BOX_LOGIT) & (sides != 0).any(-1)  # rows of zeros fill up a table
    boxes = sides[found]
    if not len(boxes):
        return
    first = f"such as ({', '.join(f'{side:.3g}' for side in boxes[0].tolist())})"
    expected = "boxes as left, top, right, bottom in pixels"
    if boxes.abs().max() <= 2:
        got = f"none that reaches beyond {float(boxes.max()):.2g} px from {name} ({first})"
        raise Refused(expected, got, 'write "head": {"name": "boxes", "unit": "share"} into its JSON')
    size = boxes[:, 2:] - boxes[:, :2]
    share = float((size <= 0).any(1).double().mean())
    seen = f"{share:.0%} with right <= left or bottom <= top"
    if share > 0.5:
        do = 'write "head": {"name": "boxes", "boxes": "cxcywh"} (or "xywh") into its JSON, or "ultralytics"'
        do = "put the upper left corner first" if bool((size < 0).all()) else do
        raise Refused(expected, f"{seen} from {name} ({first})", do)
    if share > 0.02:
        warnings.warn(f"{name} gives boxes, {seen}: are they (center, size)?", stacklevel=3)
    if runs_down_columns(sides):
        warnings.warn(f"{name} gives boxes column by column: are they (top, left, bottom, right)?", stacklevel=3)
    low, high = ends = centers_range(boxes) / classifier.input_px
    are_off = bool((high - low).min() < 0.5) or bool(((low + high) / 2 - 0.5).abs().max() > 0.1)
    if bool(((ends < -0.1) | (ends > 1.1)).any()) or (sides.shape[1] >= MANY_BOXES and are_off):
        where = " to ".join(f"({x * classifier.input_px:.0f}, {y * classifier.input_px:.0f})" for x, y in ends.tolist())
        seen = f"gives boxes around {where} in squares of {classifier.input_px} px"
        warnings.warn(f"{name} {seen}: are they of pictures of another size, or per cent?", stacklevel=3)
