"""The small detector that comes with the package: the twelve procedural objects, in boxes, 128×128 pixels.

It is trained on the renders that the built-in classifier learned from (training/train_detector.py; the recipe and the
accuracy are in builtin_detector.json), so that all verbs also run with a detector, offline. Every cell of an 8×8 grid
predicts the label of the object that it lies on and the distances to its four sides (Tian et al., FCOS, ICCV 2019),
from features of two sizes (Lin et al., feature pyramids, CVPR 2017).
"""

import torch
from torch import Tensor, nn

from patchproof.classifier.builtin import WIDTHS, Backbone, conv, load_stored_network
from patchproof.classifier.detector import Detector

INPUT_PX, CELL_PX = 128, 16
HEAD_CHANNELS = 96
MIN_LOG_SIDE, MAX_LOG_SIDE = -2.0, 2.5  # logarithms of distances in cells: 2 and 195 pixels


class SmallDetector(Backbone):
    """The backbone with a head whose cells of 16 pixels also see the cells of 32 pixels around them."""

    def __init__(self, classes: int, batch_norm: bool = False):
        super().__init__(batch_norm)
        self.join = nn.ModuleList(conv(width, HEAD_CHANNELS, 1, batch_norm) for width in WIDTHS[-2:])
        self.head = nn.ModuleList(conv(HEAD_CHANNELS, HEAD_CHANNELS, 1, batch_norm) for _ in range(2))
        self.name, self.sides = nn.Conv2d(HEAD_CHANNELS, classes, 1), nn.Conv2d(HEAD_CHANNELS, 4, 1)
        self.name.bias = nn.Parameter(torch.full((classes,), -4.0))  # most cells show no object: Lin et al., ICCV 2017

    def forward(self, photos_srgb: Tensor) -> Tensor:
        """N×3×128×128 sRGB in [0, 1] → a candidate for each of 64 cells, N×64×(4+K)."""
        fine, coarse = (join(size) for join, size in zip(self.join, self.features(photos_srgb)[-2:], strict=True))
        x = torch.relu(fine + nn.functional.interpolate(coarse, scale_factor=2.0))
        for layer in self.head:
            x = x + torch.relu(layer(x))
        return torch.cat([_boxes(self.sides(x)), self.name(x).flatten(2).mT], -1)


def centers_px(rows: int, columns: int) -> Tensor:
    """The centers of all cells, row by row, A×2 (x, y)."""
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return (torch.stack([x, y], -1).reshape(-1, 2) + 0.5) * CELL_PX


def _boxes(sides: Tensor) -> Tensor:
    """Boxes N×A×4 from the logarithms N×4×h×w of the distances to the four sides."""
    centers = centers_px(*sides.shape[-2:]).to(sides)
    distances = sides.clamp(MIN_LOG_SIDE, MAX_LOG_SIDE).exp().flatten(2).mT * CELL_PX
    return torch.cat([centers - distances[..., :2], centers + distances[..., 2:]], -1)


def load_builtin_detector() -> Detector:
    """The detector from `builtin_detector.safetensors` with the labels of `builtin_detector.json`."""
    sha256, card, network = load_stored_network(SmallDetector, "builtin_detector")
    return Detector("builtin-detector", sha256, INPUT_PX, tuple(card["labels"]), network, card["least_score"])
