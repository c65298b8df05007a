"""A detector in two stages out of the two networks that ship: `module:two_stage.rcnn`.

The first stage is the built-in detector without its names: where is anything? The second cuts each proposal out of the
picture and asks the built-in classifier for its name. That is R-CNN (Girshick et al., CVPR 2014) with proposals of a
network and crops that gradients pass (Ren et al., Faster R-CNN, NeurIPS 2015; He et al., Mask R-CNN, ICCV 2017).
Nothing is trained for it. Proposals themselves have no gradient, as in the papers.
"""

from dataclasses import replace

import torch
from torch import Tensor, nn

from patchlab.training.average_precision import suppress_overlaps
from patchproof.classifier.builtin import INPUT_PX as CROP_PX
from patchproof.classifier.builtin import load_builtin
from patchproof.classifier.builtin_detector import INPUT_PX as PROPOSED_PX
from patchproof.classifier.builtin_detector import load_builtin_detector
from patchproof.classifier.custom import detector_of
from patchproof.classifier.detector import Detector

PROPOSALS = 8  # of each picture
LEAST_SCORE = 0.25  # of best F1 on 120 renders of shapes that neither network has seen: AP50 0.885 there
MARGIN = 1.2  # of a crop's side to its proposal's longer one: the classifier has seen objects with some surroundings


class TwoStage(nn.Module):
    """N×3×S×S sRGB in [0, 1] → candidates N×`PROPOSALS`×(4+K), a score the product of both stages'."""

    def __init__(self, proposer: nn.Module, namer: nn.Module):
        super().__init__()
        self.proposer, self.namer = proposer, namer

    def forward(self, photos: Tensor) -> Tensor:
        """Proposals, crops, names."""
        found = self.proposer(photos)
        anything = found[..., 4:].amax(-1)
        with torch.no_grad():
            chosen = torch.stack([self._proposed(*each) for each in zip(found[..., :4], anything, strict=True)])
        boxes = found[..., :4].detach().gather(1, chosen[..., None].expand(-1, -1, 4))
        names = self.namer(crops(photos, boxes)).reshape(*chosen.shape, -1)
        scores = torch.log_softmax(names, -1) + nn.functional.logsigmoid(anything.gather(1, chosen))[..., None]
        scores = scores.clamp(-20, -1e-6)
        return torch.cat([boxes, scores - torch.log(-torch.expm1(scores))], -1)

    def _proposed(self, boxes: Tensor, anything: Tensor) -> Tensor:
        """Indices of the surest candidates that do not overlap; then of the surest of all, to fill up."""
        surest = anything.argsort(descending=True)
        return torch.cat([suppress_overlaps(boxes, anything), surest])[:PROPOSALS]


def crops(photos: Tensor, boxes: Tensor) -> Tensor:
    """N·A×3×`CROP_PX`×`CROP_PX`, the squares around boxes N×A×4 in pixels; gray outside of the picture."""
    many = boxes.shape[1]
    low, high = boxes.reshape(-1, 4).split(2, -1)
    middle, half = (low + high) / 2, (high - low).amax(-1, keepdim=True) / 2 * MARGIN
    steps = (torch.arange(CROP_PX, device=photos.device) + 0.5) * 2 / CROP_PX - 1
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    at = (middle[:, None, None] + half[:, None, None] * torch.stack([x, y], -1)) * 2 / photos.shape[-1] - 1
    each = photos.repeat_interleave(many, 0) - 0.5
    return nn.functional.grid_sample(each, at.to(photos), align_corners=False) + 0.5


def rcnn() -> Detector:
    """The factory that `module:two_stage.rcnn` names."""
    namer = load_builtin()
    network = TwoStage(load_builtin_detector().network, namer.network)
    made = detector_of(network, PROPOSED_PX, namer.labels, "module:two_stage.rcnn")
    return replace(made, least_score=LEAST_SCORE)
