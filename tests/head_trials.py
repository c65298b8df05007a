"""Whether detectors' raw outputs become the detections that their own packages make of them: a command, no test.

`python tests/head_trials.py --photos DIR --rows FILE` (with torchvision, transformers, onnx) makes detectors with
random weights, exports what their last layers give, reads the files by the name of the head, and holds the detections
in each photograph of DIR against those of the package's own code: torchvision's after suppression, transformers' best
100 by its processors. FILE holds a CSV row for each detector: how many detections are cut otherwise (rounding decides
where boxes overlap and where a list ends), and how many of these are lost, not even a candidate.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
import transformers as hf
from PIL import Image
from torch import Tensor, nn
from torchvision.models import detection
from torchvision.ops import batched_nms, clip_boxes_to_image

from patchproof.classifier import load_classifier

LABELS, BATCH, LEAST_SCORE = 80, 10, 0.3
SPREAD = 2.0  # of logits, which layers without training hardly have
TORCHVISION = {  # the head, the input's side, the logits' mean
    "ssd300_vgg16": ("ssd300", 300, 0),
    "ssdlite320_mobilenet_v3_large": ("ssdlite320", 320, 0),
    "retinanet_resnet50_fpn": ("retinanet", 320, -4),
    "retinanet_resnet50_fpn_v2": ("retinanet", 320, -4),
    "fcos_resnet50_fpn": ("torchvision-fcos", 320, -4),
}
SETS = "Detr TableTransformer Yolos ConditionalDetr DeformableDetr RTDetr RTDetrV2 DFine Deimv2".split()
SET_SIDE = 320
Detections = tuple[Tensor, Tensor, Tensor]  # boxes M×4 in pixels, scores, labels' numbers: of one photograph


@dataclass
class Trial:
    """A detector's raw outputs, and its detections by its package's code and from our candidates A×(4+K)."""

    side: int
    head: str
    raw: nn.Module
    theirs: Callable[[Tensor], list[Detections]]
    ours: Callable[[Tensor], tuple[Detections, Detections]]  # and all candidates before suppression


class Raw(nn.Module):
    """What a detector's last layers give: logits, boxes, and what else there is."""

    def __init__(self, model: nn.Module, mean: list[float], deviation: list[float]) -> None:
        super().__init__()
        self.model = model
        self.mean, self.deviation = (torch.tensor(each).view(3, 1, 1) for each in (mean, deviation))

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        photos = (photos - self.mean) / self.deviation
        if hasattr(self.model, "head"):  # torchvision's
            found = self.model.head(list(self.model.backbone(photos).values()))
            return tuple(found[key] for key in ("cls_logits", "bbox_regression", "bbox_ctrness") if key in found)
        found = self.model(pixel_values=photos)
        return found.logits, found.pred_boxes


def settle(raw: nn.Module, photos: Tensor) -> None:
    """Fit normalizations to the photographs, as training does: random layers would die out or explode."""
    for norm in (each for each in raw.modules() if isinstance(each, nn.BatchNorm2d)):
        norm.train().reset_running_stats()
        norm.momentum = None
    raw(photos)
    raw.eval()


def torchvision_trial(name: str, photos: Tensor) -> Trial:
    head, side, mean = TORCHVISION[name]
    background = int(name.startswith("ssd"))  # its number is 0
    options = {} if background else {"min_size": side, "max_size": side}
    options |= {"topk_candidates": 10**6, "score_thresh": LEAST_SCORE, "num_classes": LABELS + background}
    model = getattr(detection, name)(weights=None, weights_backbone=None, **options).eval()
    raw = Raw(model, model.transform.image_mean, model.transform.image_std)
    settle(raw, photos)
    factor = SPREAD / raw(photos)[0].std()
    for layer in (each for each in model.modules() if isinstance(each, nn.Conv2d)):
        if len(layer.weight) % (LABELS + background) == 0 and layer.bias is not None:  # gives logits, of each anchor
            layer.weight.mul_(factor)
            layer.bias.fill_(mean)

    def theirs(x: Tensor) -> list[Detections]:
        return [(each["boxes"], each["scores"], each["labels"] - background) for each in model(list(x))]

    def ours(rows: Tensor) -> tuple[Detections, Detections]:
        boxes, scores = clip_boxes_to_image(rows[:, :4], (side, side)), rows[:, 4:].sigmoid()
        which, label = (scores > LEAST_SCORE).nonzero(as_tuple=True)
        every = boxes[which], scores[which, label], label
        kept = batched_nms(*every, model.nms_thresh)[: model.detections_per_img]
        return (every[0][kept], every[1][kept], every[2][kept]), every

    return Trial(side, head, raw, theirs, ours)


def set_trial(name: str, photos: Tensor) -> Trial:
    config = getattr(hf, f"{name}Config")(num_labels=LABELS)
    config.use_pretrained_backbone = False
    raw = Raw(getattr(hf, f"{name}ForObjectDetection")(config).eval(), [0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
    settle(raw, photos)
    has_background = raw(photos)[0].shape[-1] > LABELS
    process = hf.DetrImageProcessor() if has_background else hf.ConditionalDetrImageProcessor()

    def theirs(x: Tensor) -> list[Detections]:
        found = SimpleNamespace(**dict(zip(("logits", "pred_boxes"), raw(x), strict=True)))
        sets = process.post_process_object_detection(found, threshold=0.0, target_sizes=len(x) * [2 * (SET_SIDE,)])
        return [(each["boxes"], each["scores"], each["labels"]) for each in sets]

    def ours(rows: Tensor) -> tuple[Detections, Detections]:
        boxes, scores = rows[:, :4], rows[:, 4:].sigmoid()
        if has_background:  # the best label of each box
            best = boxes, scores.amax(-1), scores.argmax(-1)
            return best, best
        order = scores.flatten().argsort(descending=True)[:200]
        every = boxes[order // LABELS], scores.flatten()[order], order % LABELS
        return (every[0][:100], every[1][:100], every[2][:100]), every

    return Trial(SET_SIDE, "detr", raw, theirs, ours)


def compare(some: Detections, others: Detections) -> tuple[Tensor, float, float]:
    """Which of `some` lack one of `others` (same label, 0.01 of score, 1 px); the rest's largest differences."""
    boxes, scores = torch.cdist(some[0], others[0], float("inf")), (some[1][:, None] - others[1]).abs()
    far = (some[2][:, None] != others[2]) | (scores > 0.01) | (boxes > 1)
    if not far.numel():
        return torch.ones(len(some[0]), dtype=torch.bool), 0.0, 0.0
    nearest = (boxes + 100 * scores).masked_fill(far, torch.inf).argmin(1, keepdim=True)
    lacks = far.gather(1, nearest)
    box_px, score = (float((each.gather(1, nearest) * ~lacks).max()) for each in (boxes, scores))
    return lacks[:, 0], box_px, score


def try_detector(name: str, pictures: list[Image.Image]) -> dict[str, object]:
    torch.manual_seed(0)
    side = TORCHVISION[name][1] if name in TORCHVISION else SET_SIDE
    photos = torch.stack([torch.tensor(np.asarray(each.resize((side, side)))) for each in pictures])
    photos = photos.permute(0, 3, 1, 2).float() / 255
    trial = (torchvision_trial if name in TORCHVISION else set_trial)(name, photos[:8])
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.onnx"
        any_number = {"input_names": ["photos"], "dynamic_axes": {"photos": {0: "n"}}, "opset_version": 17}
        torch.onnx.export(trial.raw, (photos[:2],), str(file), dynamo=False, **any_number)
        labels = [f"label {number}" for number in range(LABELS)]
        card = {"input_px": side, "kind": "detector", "labels": labels, "head": trial.head}
        file.with_suffix(".json").write_text(json.dumps(card), encoding="utf-8")
        with torch.enable_grad():  # it tries one
            network = load_classifier(f"file:{file}").network
        for batch in photos.split(BATCH):
            for theirs, candidates in zip(trial.theirs(batch), network(batch), strict=True):
                ours, every = trial.ours(candidates)
                lacks, *off = compare(theirs, ours)
                lost, *_ = compare((theirs[0][lacks], theirs[1][lacks], theirs[2][lacks]), every)
                rows.append((len(lacks), lacks.sum(), lost.sum(), compare(ours, theirs)[0].sum(), *off))
    found, missed, lost, more, box_px, score = np.array(rows, float).T
    counts = {"detections": found.sum(), "cut otherwise": missed.sum(), "lost": lost.sum(), "ours only": more.sum()}
    largest = {"box off px": f"{box_px.max():.2g}", "score off": f"{score.max():.2g}"}
    return {"detector": name, "photographs": len(photos), **{key: int(each) for key, each in counts.items()}, **largest}


@torch.no_grad()
def main(photos: Path, rows: Path, names: list[str]) -> None:
    """Try every detector on the folder's photographs."""
    pictures = [Image.open(path).convert("RGB") for path in sorted(photos.iterdir())]
    with rows.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        for number, name in enumerate(names or [*TORCHVISION, *SETS]):
            row = try_detector(name, pictures)
            writer.writerows([row.keys(), row.values()] if number == 0 else [row.values()])
            file.flush()
            print(row, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("names", nargs="*", help="detectors, all by default")
    given = parser.parse_args()
    main(given.photos, given.rows, given.names)
