"""Say that a network of ImageNet labels was wrapped wrongly, and how it answers better.

In: a classifier that knows at least `LEAST_LABELS` of the 1,000 ImageNet labels by name. Out: a warning, or a refusal
where it is certain, if the network agrees better with `imagenet` once its pictures have another range or order of
colors, or its labels are moved by one place. Agreement is the correlation of logits, less their means over labels and
over pictures, on twelve pictures of `wrapping.jpg`: renders of our primitives and our own patterns, chosen with three
networks from 52, so that they agree by at least 0.05 less after any of these changes; three others by 0.02 less.
Left out on purpose: other label sets, detectors, and networks where `imagenet` is not installed.
"""

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.classifier.network import Classifier, center_square

LEAST_LABELS = 300
GAIN = 0.01  # in agreement, from which a change is said to fit better
CHANCE, CERTAIN = 0.1, 0.2  # a network that agrees by less than the first, and by the second more after a change
MOST_WEIGHTS = 30e6  # of a network, beyond which only a swap of colors and the labels are tried: it would take long
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


def check_wrapping(classifier: Classifier, device: torch.device | str) -> None:
    """Warn or refuse where a classifier of ImageNet labels answers better to changed pictures or with moved labels."""
    from patchproof.classifier.imagenet import has_imagenet

    if classifier.LOOKS_AT_BOXES or not has_imagenet():
        return
    labels, expected = _reference()
    if len(matched := _same_labels(classifier.labels, labels)) < LEAST_LABELS:
        return
    pictures = center_square(_pictures(), classifier.input_px).to(device)
    compare = partial(_agreements, classifier, pictures, matched, expected)
    network = classifier.network
    state = network.state_dict() if isinstance(network, torch.nn.Module) else {}
    agreements: dict[tuple[str, int], float] = {}
    for name in _RANGES if sum(each.numel() for each in state.values()) < MOST_WEIGHTS else (_AS_WRAPPED,):
        agreements |= compare(name)
    for name in sorted({name for name, _ in agreements}, key=lambda name: -agreements[name, 0])[:3]:
        agreements |= compare(f"{name} and {_SWAPPED}" if name else _SWAPPED)
    told, (best, move) = agreements[_AS_WRAPPED, 0], max(agreements, key=lambda key: agreements[key])
    gain, who = agreements[best, move] - told, f"the network {classifier.name}"
    change = " and ".join(text for text in (best, _MOVES[move]) if text)
    seen = f"{told:.2f} as it is wrapped, {told + gain:.2f} with {change}"
    if told < CHANCE and gain > CERTAIN:
        got = f"{who}, whose logits correlate with imagenet's by {seen}"
        raise Refused("a network that is wrapped as it was trained", got, f"wrap it with {change}")
    if told + gain < CHANCE:
        text = "and no better with other ranges or orders of colors: do its labels have another order?"
        warnings.warn(f"{who} has logits that correlate with imagenet's by {told:.2f}, {text}", stacklevel=2)
    elif gain > GAIN:
        warnings.warn(f"{who} may be wrapped wrongly: its logits correlate with imagenet's by {seen}", stacklevel=2)


def _agreements(
    classifier: Classifier, pictures: Tensor, matched: np.ndarray, expected: Tensor, name: str
) -> dict[tuple[str, int], float]:
    """The agreement after one change of the pictures, by its name and the move of the labels."""
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
    """The mean over pictures of the correlation of two N×K logits, less their means over labels and pictures; -1 for
    logits that are not finite.
    """
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
    grid = pixels.reshape(_ROWS, side, _COLUMNS, side, 3)
    return grid.permute(0, 2, 4, 1, 3).reshape(-1, 3, side, side)


@cache
def _reference() -> tuple[tuple[str, ...], Tensor]:
    """The labels of `imagenet`, and its logits of the pictures, float64."""
    from patchproof.classifier.imagenet import load_imagenet

    network = load_imagenet()
    with torch.no_grad():
        return network.labels, network.square_logits(center_square(_pictures(), network.input_px)).double()
