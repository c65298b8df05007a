"""Warn of a network that was wrapped wrongly, by its answers to twelve pictures.

In: a classifier or detector that shares labels' names with one whose wrapping is known (`_references`). Out: a warning,
or a refusal where it is certain, if the two agree better once the pictures have another range or order of colors, or
labels are moved by one place. Agreement is the correlation of logits, less their means over labels and over pictures,
on the pictures of `wrapping.jpg`: renders of our primitives and our own patterns, chosen with three classifiers from
52, so that they agree by at least 0.05 less after any of these changes; three others by 0.02 less. Logits of COCO's
labels by two detectors are stored in `wrapping.json`, which says where they come from. Left out on purpose: other label
sets, and ImageNet's where `imagenet` is not installed.
"""

import json
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.input import remaining_seconds
from patchproof.classifier.network import Classifier, center_square

LEAST_LABELS = 300  # of ImageNet's
CHANCE, CERTAIN = 0.1, 0.2  # a network that agrees by less than the first, and by the second more after a change
MOST_WEIGHTS = 30e6  # of a network; beyond, or without the time, only a swap of colors and the labels are tried
_ROWS, _COLUMNS = 3, 4
_MEAN, _DEVIATION = (torch.tensor(each).view(3, 1, 1) for each in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
_AS_WRAPPED, _SWAPPED = "", "red and blue swapped"
_RANGES: dict[str, Callable[[Tensor], Tensor]] = {
    _AS_WRAPPED: lambda x: x,
    "pictures in 0 to 255": lambda x: 255 * x,
    "pictures 255 times darker": lambda x: x / 255,
    "pictures in -1 to 1": lambda x: 2 * x - 1,
    "pictures that are not put in -1 to 1 a second time": lambda x: (x + 1) / 2,
    "ImageNet's mean and deviation taken off": lambda x: (x - _MEAN.to(x)) / _DEVIATION.to(x),
    "ImageNet's mean and deviation not taken off a second time": lambda x: x * _DEVIATION.to(x) + _MEAN.to(x),
    "pictures in 0 to 255 with ImageNet's mean taken off": lambda x: 255 * (x - _MEAN.to(x)),
}
_MOVES = {0: "", 1: "each label moved to the output before", -1: "each label moved to the output behind"}


class _Reference(NamedTuple):
    """Logits of the pictures by a network whose wrapping is known, and how they are compared with others'."""

    whose: str
    labels: Sequence[str]
    logits: Callable[[], Tensor]
    least_labels: int  # that both know
    gain: float  # in agreement, from which a change is said to fit better
    sure: float = 1.0  # in agreement, from which no change is tried
    least: float = -1.0  # in agreement after the best change, below which nothing is said


def check_wrapping(classifier: Classifier, device: torch.device | str) -> None:
    """Warn or refuse where a network answers better to changed pictures or with moved labels."""
    for reference in _references(classifier.LOOKS_AT_BOXES, len(classifier.labels) >= LEAST_LABELS):
        matched = _same_labels(classifier.labels, reference.labels)
        if len(matched) >= reference.least_labels:
            return _compare(classifier, device, matched, reference)


def _compare(classifier: Classifier, device: torch.device | str, matched: np.ndarray, reference: _Reference) -> None:
    pictures = center_square(_pictures(), classifier.input_px).to(device)
    compare = partial(_agreements, classifier, pictures, matched, reference.logits())
    network = classifier.network
    state, start = network.state_dict() if isinstance(network, torch.nn.Module) else {}, time.process_time()
    agreements = compare(_AS_WRAPPED)
    has_time = remaining_seconds() > 2 * len(_RANGES) * (time.process_time() - start)
    if (told := agreements[_AS_WRAPPED, 0]) > reference.sure:
        return
    for name in _RANGES if has_time and sum(each.numel() for each in state.values()) < MOST_WEIGHTS else ():
        agreements |= compare(name) if name else {}
    for name in sorted({name for name, _ in agreements}, key=lambda name: -agreements[name, 0])[:3]:
        agreements |= compare(f"{name} and {_SWAPPED}" if name else _SWAPPED)
    best, move = max(agreements, key=lambda key: agreements[key])
    gain, who = agreements[best, move] - told, f"the network {classifier.name}"
    if told + gain < reference.least:
        return
    change = " and ".join(text for text in (best, _MOVES[move]) if text)
    seen = f"{reference.whose} by {told:.2f} as it is wrapped, {told + gain:.2f} with {change}"
    if told < CHANCE and gain > CERTAIN:
        got = f"{who}, whose logits correlate with {seen}"
        raise Refused("a network that is wrapped as it was trained", got, f"wrap it with {change}")
    if told + gain < CHANCE:
        text = "and no better with other ranges or orders of colors: do its labels have another order?"
        warnings.warn(f"{who} has logits that correlate with {reference.whose} by {told:.2f}, {text}", stacklevel=4)
    elif gain > reference.gain:
        warnings.warn(f"{who} may be wrapped wrongly: its logits correlate with {seen}", stacklevel=4)


def _agreements(
    classifier: Classifier, pictures: Tensor, matched: np.ndarray, expected: Tensor, name: str
) -> dict[tuple[str, int], float]:
    """Return the agreement after one change of the pictures for each move of the labels: by (change, move)."""
    changed = _RANGES[name.removesuffix(_SWAPPED).removesuffix(" and ")](pictures)
    with torch.no_grad():
        logits = classifier.square_logits(changed.flip(1) if name.endswith(_SWAPPED) else changed).cpu().double()
    found = {}
    for move in _MOVES:
        own = matched[:, 0] + move
        inside = (own >= 0) & (own < logits.shape[1])
        found[name, move] = _correlation(logits[:, own[inside]], expected[:, matched[inside, 1]])
    return found


def _correlation(logits: Tensor, expected: Tensor) -> float:
    """The mean correlation of N×K logits, less their means over labels and pictures; -1 if they are not finite."""
    first, second = (each - each.mean(1, keepdim=True) for each in (logits, expected))
    first, second = first - first.mean(0), second - second.mean(0)
    value = float(torch.nn.functional.cosine_similarity(first, second, dim=1).mean())
    return value if np.isfinite(value) else -1.0


def _same_labels(labels: Sequence[str], others: Sequence[str]) -> np.ndarray:
    """Indices M×2 of labels in both lists with the same first name, where it is in each once."""
    first, second = ([" ".join(entry.split(",")[0].casefold().split()) for entry in each] for each in (labels, others))
    counts, where = (Counter(first), Counter(second)), {name: index for index, name in enumerate(second)}
    pairs = [(index, where[name]) for index, name in enumerate(first) if all(each[name] == 1 for each in counts)]
    return np.array(pairs, int).reshape(-1, 2)


@cache
def _pictures() -> Tensor:
    """The twelve pictures, 12×3×P×P sRGB in [0, 1]."""
    from PIL import Image

    with Image.open(Path(__file__).with_name("wrapping.jpg")) as sheet:
        pixels = torch.from_numpy(np.asarray(sheet.convert("RGB")).copy()).float() / 255
    side = pixels.shape[0] // _ROWS
    return pixels.reshape(_ROWS, side, _COLUMNS, side, 3).permute(0, 2, 4, 1, 3).reshape(-1, 3, side, side)


@cache
def _references(of_boxes: bool, has_many_labels: bool) -> list[_Reference]:
    """The networks that a classifier, or a detector, is compared with; the first that shares labels counts."""
    from patchproof.classifier.imagenet import has_imagenet, load_imagenet

    if of_boxes:
        from patchproof.classifier.builtin_detector import load_builtin_detector as load_own

        stored = json.loads(Path(__file__).with_name("wrapping.json").read_text(encoding="utf-8"))
        expected = torch.tensor(stored["logits"]).double()
        found = [_Reference("two COCO detectors'", stored["labels"], lambda: expected, 40, 0.05, 0.75)]
    else:
        from patchproof.classifier.builtin import load_builtin as load_own

        network = load_imagenet() if has_many_labels and has_imagenet() else None
        found = [_Reference("imagenet's", network.labels, _logits_of(network), LEAST_LABELS, 0.01)] if network else []
    own = load_own()
    return [*found, _Reference(f"{own.name}'s", own.labels, _logits_of(own), 8, 0.05, 0.95, 0.5)]


def _logits_of(network: Classifier) -> Callable[[], Tensor]:
    """A function that computes a network's logits of the pictures, float64, once."""

    @cache
    def compute() -> Tensor:
        with torch.no_grad():
            return network.square_logits(center_square(_pictures(), network.input_px)).double()

    return compute
