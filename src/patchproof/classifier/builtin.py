"""The small network that comes with the package: twelve procedural objects, 96×96 pixels, about half a million weights.

It is trained on renders of our own primitives (training/train_builtin.py; the recipe and the accuracy are in
builtin.json), so that the demo needs no network and no download. It knows nothing of the real world: for real objects
name a torchvision, timm or exported model. Convolutions and ReLUs only: BatchNorm is folded into the convolutions
before saving, which is faster and leaves nothing that depends on the batch. Weights are stored as float16.
"""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from patchproof.base.errors import Refused
from patchproof.classifier.network import Classifier

INPUT_PX = 96
WIDTHS = (16, 32, 64, 96, 160)  # channels after each halving of the picture: 48, 24, 12, 6, 3 pixels
MEAN, DEVIATION = 0.45, 0.27  # roughly those of sRGB photographs; the first layer learns the rest
WEIGHTS_FOLDER = Path(__file__).parent


class Backbone(nn.Module):
    """Five strided convolutions, each of which halves the picture; a residual one follows each but the first."""

    def __init__(self, batch_norm: bool):
        super().__init__()
        self.halve = nn.ModuleList(conv(a, b, 2, batch_norm) for a, b in zip((3, *WIDTHS), WIDTHS, strict=False))
        self.refine = nn.ModuleList(conv(width, width, 1, batch_norm) for width in WIDTHS[1:])

    def features(self, photos_srgb: Tensor) -> list[Tensor]:
        """The feature maps after each halving but the first, of N×3×S×S sRGB in [0, 1]."""
        x, sizes = torch.relu(self.halve[0]((photos_srgb - MEAN) / DEVIATION)), []
        for halve, refine in zip(self.halve[1:], self.refine, strict=True):
            x = torch.relu(halve(x))
            x = x + torch.relu(refine(x))
            sizes.append(x)
        return sizes


class SmallNetwork(Backbone):
    """The backbone, the mean over pixels, and a linear layer."""

    def __init__(self, classes: int, batch_norm: bool = False):
        super().__init__(batch_norm)
        self.classify = nn.Linear(WIDTHS[-1], classes)

    def forward(self, photos_srgb: Tensor) -> Tensor:
        """N×3×96×96 sRGB in [0, 1] → N×K logits."""
        return self.classify(self.features(photos_srgb)[-1].mean((2, 3)))


def load_builtin(folder: Path = WEIGHTS_FOLDER) -> Classifier:
    """The network from `builtin.safetensors` with the labels of `builtin.json`."""
    sha256, card, network = load_stored_network(SmallNetwork, "builtin", folder)
    return Classifier("builtin", sha256, INPUT_PX, tuple(card["labels"]), network)


def load_stored_network(
    kind: Callable[[int], nn.Module], name: str, folder: Path = WEIGHTS_FOLDER
) -> tuple[str, dict[str, Any], nn.Module]:
    """SHA-256 of the weights NAME.safetensors, the contents of NAME.json, and the network of this `kind` with them."""
    from safetensors.torch import load

    weights, card_path = folder / f"{name}.safetensors", folder / f"{name}.json"
    if not weights.is_file() or not card_path.is_file():
        got = f"no {name}.safetensors with {name}.json in {folder}"
        raise Refused("the built-in network's weights", got, "install patchproof again")
    stored = weights.read_bytes()
    card = json.loads(card_path.read_text(encoding="utf-8"))
    network = kind(len(card["labels"]))
    network.load_state_dict({key: tensor.float() for key, tensor in load(stored).items()})
    return hashlib.sha256(stored).hexdigest(), card, network.eval()


def conv(before: int, after: int, stride: int, batch_norm: bool) -> nn.Module:
    """A 3×3 convolution, with BatchNorm while it is trained."""
    plain = nn.Conv2d(before, after, 3, stride, padding=1, bias=not batch_norm)
    return nn.Sequential(plain, nn.BatchNorm2d(after)) if batch_norm else plain
