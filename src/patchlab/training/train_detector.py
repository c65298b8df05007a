"""Train the built-in detector: `python -m patchlab.training.train_detector --out DIR`.

In: seeds (`training.pictures`). Out: `builtin_detector.safetensors` and `builtin_detector.json` with the recipe,
its seeds and the average precision on shapes, textures and backgrounds that training never saw. A third of the training
pictures are mosaics of four, so that objects of all sizes appear alone and together.

Cells in the middle half of an object's box predict it. Their target score is the overlap of their box with the true
one (Li et al., Generalized focal loss, NeurIPS 2020), their boxes follow the generalized IoU (Rezatofighi et al., CVPR
2019).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchlab.training import fit
from patchlab.training.average_precision import Detection, average_precision, find_detections
from patchlab.training.fit import round_by_class, store_float16, write_card
from patchlab.training.pictures import Pictures, augment
from patchproof.classifier.builtin_detector import INPUT_PX, SmallDetector, centers_px
from patchproof.classifier.detector import iou
from patchproof.mesh import primitives


@dataclass(frozen=True)
class DetectorRecipe(fit.TrainingRecipe):
    """The detector's recipe: fewer pictures than the classifier's, some of them mosaics."""

    pictures_per_class: int = 1200
    held_out_per_class: int = 100
    mosaics: float = 0.33  # share of pictures that are mosaics of four


def train(pictures: Pictures, recipe: DetectorRecipe) -> fit.Epochs:
    """Train the detector; yields (number, mean loss, network) after each epoch."""

    def learn(network: torch.nn.Module, rows: Tensor, cards: Tensor, rng: np.random.Generator) -> Tensor:
        images, boxes = augment(pictures.images[rows], pictures.boxes[rows], cards, rng, recipe.pasted, widest=1.4)
        images, labels, boxes = with_mosaics(images, pictures.labels[rows], boxes, recipe.mosaics, rng)
        return detector_loss(network(images.contiguous(memory_format=torch.channels_last)), labels, boxes * INPUT_PX)

    make = partial(SmallDetector, len(primitives.primitive_names()), batch_norm=True)
    return fit.train_epochs(make, pictures, recipe, learn)


def with_mosaics(
    images: Tensor, labels: Tensor, boxes: Tensor, share: float, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Replace a share of pictures by mosaics of four at half size; labels become N×4 (-1: none), boxes N×4×4."""
    n = len(images)
    all_labels = torch.cat([labels[:, None], labels.new_full((n, 3), -1)], 1)
    all_boxes = torch.cat([boxes[:, None], boxes.new_zeros(n, 3, 4)], 1)
    mixed = images.clone()
    small = torch.nn.functional.interpolate(images, scale_factor=0.5, mode="bilinear", antialias=True)
    half = small.shape[-1]
    for i in np.flatnonzero(rng.random(n) < share):
        for place, other in enumerate(rng.choice(n, 4, replace=False)):
            row, column = divmod(place, 2)
            mixed[i, :, row * half : (row + 1) * half, column * half : (column + 1) * half] = small[other]
            all_labels[i, place] = labels[other]
            all_boxes[i, place] = (boxes[other] + torch.tensor([column, row, column, row])) / 2
    return mixed, all_labels, all_boxes


def detector_loss(candidates: Tensor, labels: Tensor, boxes_px: Tensor) -> Tensor:
    """The loss, of classes and boxes, of candidates N×A×(4+K) for objects with labels N×M (-1: none), boxes N×M×4."""
    boxes, logits = candidates.split([4, candidates.shape[-1] - 4], -1)
    answers_for = assign_objects(labels, boxes_px)
    view, cell = torch.nonzero(answers_for >= 0, as_tuple=True)
    target = answers_for[view, cell]
    truth, predicted = boxes_px[view, target], boxes[view, cell]
    overlap, hull_share = _overlaps(predicted, truth)
    wanted = torch.zeros_like(logits)
    wanted[view, cell, labels[view, target]] = overlap.detach().clamp_min(0)
    focus = (wanted - torch.sigmoid(logits)).detach().abs() ** 2
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    count = max(len(view), 1)
    return (focus * entropy).sum() / count + (1 - overlap + hull_share).sum() / count


def assign_objects(labels: Tensor, boxes_px: Tensor) -> Tensor:
    """N×A: the index of the object that a cell predicts, the smallest of those whose middle half (at least 8 px) holds
    the cell's center; -1 for none.
    """
    cells = INPUT_PX // 16
    centers = centers_px(cells, cells)
    middle, size = (boxes_px[..., :2] + boxes_px[..., 2:]) / 2, boxes_px[..., 2:] - boxes_px[..., :2]
    reach = torch.maximum(size / 4, size.new_tensor(8.0))
    inside = ((centers[None, :, None] - middle[:, None]).abs() <= reach[:, None]).all(-1)  # N×A×M
    areas = size.prod(-1).masked_fill((labels < 0) | (size.amin(-1) < 4), torch.inf)
    nearest = torch.where(inside, areas[:, None], torch.inf)
    area, owner = nearest.min(-1)
    return torch.where(torch.isfinite(area), owner, -1)


def _overlaps(predicted: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """IoU of boxes P×4 with the true ones, and the share of their common bounding box that neither covers."""
    overlap = iou(predicted[:, None], truth)[:, 0]
    areas = (predicted[:, 2:] - predicted[:, :2]).prod(-1) + (truth[:, 2:] - truth[:, :2]).prod(-1)
    low, high = torch.minimum(predicted[:, :2], truth[:, :2]), torch.maximum(predicted[:, 2:], truth[:, 2:])
    hull = (high - low).prod(-1).clamp_min(1e-6)
    return overlap, 1 - areas / (1 + overlap) / hull


@torch.no_grad()
def detections_by_class(network: torch.nn.Module, pictures: Pictures) -> list[list[Detection]]:
    """Detections of each class in pictures with one object each."""
    was_training = network.training
    network.eval()
    candidates = torch.cat([network(batch.float() / 255) for batch in pictures.images.split(256)])
    network.train(was_training)
    boxes_px, labels = pictures.boxes * INPUT_PX, range(len(primitives.primitive_names()))
    return [find_detections(candidates, [label], boxes_px, (pictures.labels == label).tolist()) for label in labels]


def score_network(network: torch.nn.Module, pictures: Pictures) -> np.ndarray:
    """AP50 of each class for a network."""
    return ap50_by_class(detections_by_class(network, pictures), pictures)


def ap50_by_class(found: Sequence[Sequence[Detection]], pictures: Pictures) -> np.ndarray:
    """AP50 of each class from its detections."""
    counts = pictures.labels.bincount(minlength=len(found)).tolist()
    return np.array([average_precision(each, count) for each, count in zip(found, counts, strict=True)])


def write(
    out: Path, trained: torch.nn.Module, recipe: DetectorRecipe, held_out: Pictures, seconds: fit.Seconds
) -> None:
    """Write the weights and their card; the average precision is that of the stored weights."""
    network = fit.fold_batch_norm(trained)
    count = store_float16(network, out / "builtin_detector.safetensors")
    found = detections_by_class(network, held_out)
    ap50 = ap50_by_class(found, held_out)
    figures = {
        "input_px": INPUT_PX,
        "weights": count,
        "least_score": best_score(chain(*found), len(held_out.labels)),  # of best F1 on the held-out pictures
        "held_out_ap50": round(float(ap50.mean()), 4),
        "held_out_ap50_by_class": round_by_class(ap50),
    }
    write_card(out / "builtin_detector.json", figures, "train_detector", recipe, seconds)
    print(f"held-out AP50 {figures['held_out_ap50']:.3f}: {figures['held_out_ap50_by_class']}")


def best_score(found: Iterable[Detection], objects: int) -> float:
    """The score threshold, in twentieths, with the highest F1 of detections of this number of objects."""

    def f1(score: float) -> float:
        right = [finding.is_hit for finding in known if 1 / (1 + np.exp(-finding.logit)) >= score]
        return 2 * sum(right) / (len(right) + objects)

    known = list(found)
    return max((i / 20 for i in range(1, 20)), key=f1)


def main() -> None:
    """Render, train, measure, and write the network with its card."""
    about = "Train the built-in detector from procedural renders."
    fit.run(DetectorRecipe, about, INPUT_PX, train, score_network, write)


if __name__ == "__main__":
    main()
