"""How often a network that is wrapped wrongly is told so, and one that is wrapped rightly is not: a command, no test.

`PATCHPROOF_DATA=DIR python tests/wrapping_trials.py --rows FILE` wraps the networks of DIR, `imagenet`'s where they are
installed and our own in each of the ways below, loads them, and holds what is said against the words that name the way.
FILE holds a CSV row for each; those of one network are not independent, since its pictures and logits are the same.
"""

from __future__ import annotations

import argparse
import csv
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.intervals import wilson
from patchproof.classifier import load_classifier
from patchproof.classifier.custom import classifier_of, detector_of
from patchproof.classifier.network import Classifier

MEAN, DEVIATION = (torch.tensor(each).view(3, 1, 1) for each in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
Change = tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor], Callable[[list[str]], list[str]]]


def same(x):
    return x


def halves(boxes: Tensor) -> tuple[Tensor, Tensor]:
    return boxes[..., :2], boxes[..., 2:4]


def of_boxes(change: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda rows: torch.cat([change(rows[..., :4]), rows[..., 4:]], -1)


def of_logits(change: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda rows: torch.cat([rows[..., :4], change(rows[..., 4:])], -1)


# what is done to pictures, to outputs and to labels, and a word that names it
PICTURES_WRONG = {
    "BGR": (lambda x: x.flip(1), same, same, "red and blue swapped"),
    "255 times as bright": (lambda x: 255 * x, same, same, "255"),
    "normalization left out": (lambda x: (x + 1) / 2, same, same, "-1 to 1"),
    "normalized to -1 to 1 twice": (lambda x: 2 * x - 1, same, same, "a second time"),
    "ImageNet's mean taken off twice": (lambda x: (x - MEAN) / DEVIATION, same, same, "a second time"),
    "labels moved by one": (same, same, lambda names: ["background", *names[:-1]], "each label moved"),
}
CLASSES_WRONG = PICTURES_WRONG | {
    "probabilities": (same, lambda y: y.softmax(-1), same, "probabilities"),
    "per cent": (same, lambda y: 100 * y.softmax(-1), same, "probabilities"),
    "a sigmoid each": (same, lambda y: y.sigmoid(), same, "probabilities"),
    "a row without a label": (same, same, lambda names: names[1:], "logits for each picture"),
}
BOXES_WRONG = PICTURES_WRONG | {
    "probabilities": (same, of_logits(torch.sigmoid), same, "probabilities"),
    "centers and sizes": (
        same,
        of_boxes(lambda b: torch.cat([(halves(b)[0] + halves(b)[1]) / 2, halves(b)[1] - halves(b)[0]], -1)),
        same,
        "cxcywh",
    ),
    "boxes in shares": (same, of_boxes(lambda b: b / 320), same, "share"),
    "boxes by row": (same, of_boxes(lambda b: b[..., [1, 0, 3, 2]]), same, "yxyx"),  # read as it is, and said
}
CLASSES_RIGHT = {
    "as it is": (same, same, same),
    "half as sure": (same, lambda y: y / 2, same),
    "logarithms of probabilities": (same, lambda y: y.log_softmax(-1), same),
    "outputs and labels in another order": (same, lambda y: y.flip(-1), lambda names: names[::-1]),
    "a background's row, with its label": (
        same,
        lambda y: torch.cat([torch.full_like(y[:, :1], -9.0), y], 1),
        lambda names: ["background", *names],
    ),
}
BOXES_RIGHT = {
    "as it is": (same, same, same),
    "half as sure": (same, of_logits(lambda y: y / 2), same),
    "outputs and labels in another order": (same, of_logits(lambda y: y.flip(-1)), lambda names: names[::-1]),
}


def networks() -> Iterator[Classifier]:
    data = Path(os.environ["PATCHPROOF_DATA"])
    files = [f"file:{path}" for folder in ("models", "detectors") for path in sorted((data / folder).glob("*.onnx"))]
    for name in ("builtin", "builtin-detector", "imagenet", "imagenet:lite1", "imagenet:lite2", *files):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                yield load_classifier(name)
            except Refused as refused:
                print(f"{name}: {refused}")


def what_is_said(network: Classifier, pictures, outputs, labels) -> str:
    wrap = detector_of if network.LOOKS_AT_BOXES else classifier_of
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            load_classifier(
                wrap(lambda x: outputs(network.network(pictures(x))), network.input_px, labels(list(network.labels)))
            )
    except Refused as refused:
        return f"refused: {refused}"
    return "; ".join(str(each.message) for each in said)


def main(rows: Path) -> None:
    """Try every network in every way."""
    named: dict[str, list[bool]] = {"wrong": [], "right": []}
    with rows.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("network", "wrapped", "way", "as it should be", "said"))
        for network in networks():
            wrong = BOXES_WRONG if network.LOOKS_AT_BOXES else CLASSES_WRONG
            right = BOXES_RIGHT if network.LOOKS_AT_BOXES else CLASSES_RIGHT
            trials = [("wrong", way, change, word) for way, (*change, word) in wrong.items()]
            for kind, way, change, word in trials + [("right", way, change, "") for way, change in right.items()]:
                said = what_is_said(network, *change)
                named[kind].append(word in said if word else not said)
                name = network.name.rpartition("/")[2].removesuffix(".onnx")
                writer.writerow((name, kind, way, named[kind][-1], said))
                file.flush()
    for kind, hits in named.items():
        low, high = wilson(sum(hits), len(hits))
        words = "named rightly" if kind == "wrong" else "without a word"
        print(f"{kind}: {sum(hits)} of {len(hits)} {words} [{100 * low:.1f}, {100 * high:.1f}]")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=Path, required=True)
    main(parser.parse_args().rows)
