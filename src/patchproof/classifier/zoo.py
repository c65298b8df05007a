"""`torchvision:NAME` and `timm:NAME`: published networks with their published weights, or with those of a file.

The weights are downloaded by these libraries, and only because the scene file names the model; `timm:hf-hub:ORG/NAME`
is one of the hub's. With `NAME@FILE.safetensors` they are the file's, read as numbers, never as a pickle; a network
trained for other labels says these, and its input size, in FILE.json beside it. The libraries are not needed otherwise:
where one is missing, the sentence says what to install. Input size, labels and the mean and standard deviation that the
weights were trained with are the library's own figures; normalization is put inside the network.
Their resize-then-crop is left out on purpose: here every network sees the whole centered square.
"""

from __future__ import annotations

import hashlib
import importlib
import re
import socket
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies

import torch
from torch import Tensor, nn

from patchproof.base.errors import Refused
from patchproof.base.input import is_file
from patchproof.classifier.check import error_summary
from patchproof.classifier.custom import MAX_DETECTIONS, classifier_of, detector_of
from patchproof.classifier.detector import Detector
from patchproof.classifier.labels import nearest_names
from patchproof.classifier.network import Classifier
from patchproof.classifier.network_file import Card, network_bytes, read_card


class Normalized(nn.Module):
    """A network that wants (x - mean) / std, as one that takes sRGB in [0, 1]."""

    def __init__(self, network: nn.Module, mean: Sequence[float], std: Sequence[float]):
        super().__init__()
        self.network = network
        self.mean = nn.Buffer(torch.tensor(mean).reshape(1, -1, 1, 1))
        self.std = nn.Buffer(torch.tensor(std).reshape(1, -1, 1, 1))

    def forward(self, photos_srgb: Tensor) -> Tensor:
        """N×3×S×S sRGB in [0, 1] → N×K logits."""
        return self.network((photos_srgb - self.mean) / self.std)


def load_torchvision(name: str) -> Classifier:
    """A torchvision classification or detection model with its default weights; a classifier's may be a file's."""
    models = library("torchvision", "torchvision").models
    if name in models.list_models(module=models.detection):
        return _detector(models, name)
    name, own = _own_weights(name)
    known = models.list_models(module=models)  # segmentation, detection and video have modules of their own
    if name not in known:
        do = nearest_names(name, known, "choose one of torchvision.models.list_models()")
        raise Refused("a torchvision classifier or detector", f'"{name}"', do)
    weights = models.get_model_weights(name).DEFAULT
    view = weights.transforms()
    side_px, labels = (own and own.card and own.card[:2]) or (int(view.crop_size[0]), weights.meta["categories"])
    if own is None:
        network = downloaded(f"torchvision:{name}", lambda: models.get_model(name, weights=weights))
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of how it begins, before the file's weights are in it
            network = models.get_model(name, weights=None, num_classes=len(labels))
        if hasattr(network, "transform_input"):  # Inception's published weights are for another normalization
            network.transform_input = True
    return _with(own, network, view.mean, view.std, side_px, labels, f"torchvision:{name}")


# of torchvision's detectors by what their constructors call it: as many candidates as there are, none suppressed
_RAW = {"score_thresh": 1e-3, "nms_thresh": 1.0, "detections_per_img": MAX_DETECTIONS}


def _detector(models: Any, name: str) -> Detector:
    """A torchvision detector with its default weights, before suppression."""
    weights = models.get_model_weights(name).DEFAULT
    raw = {f"box_{key}": value for key, value in _RAW.items()} if "rcnn" in name else _RAW
    network = downloaded(f"torchvision:{name}", lambda: models.get_model(name, weights=weights, **raw))
    view = network.transform
    input_px = view.fixed_size[0] if getattr(view, "fixed_size", None) else view.min_size[0]
    return detector_of(network, int(input_px), weights.meta["categories"], f"torchvision:{name}")


def load_timm(name: str) -> Classifier:
    """A timm model with its pretrained weights or a file's, where its labels are known."""
    timm = library("timm", "timm")
    name, own = _own_weights(name)
    if not (timm.is_model(name) or (name.startswith("hf-hub:") and own is None)):
        do = nearest_names(name, timm.list_models(), "choose one of timm.list_models()")
        raise Refused("a timm model", f'"{name}"', do)
    if own is None:
        with _offline_at_once():
            network = downloaded(f"timm:{name}", lambda: timm.create_model(name, pretrained=True))
    else:
        network = timm.create_model(name, **({"num_classes": len(own.card[1])} if own.card else {}))
    view = timm.data.resolve_model_data_config(network)
    own_card = own and own.card and own.card[:2]
    side_px, labels = own_card or (int(view["input_size"][-1]), _timm_labels(timm, network, name))
    return _with(own, network, view["mean"], view["std"], side_px, labels, f"timm:{name}")


def _timm_labels(timm: Any, network: Any, name: str) -> list[str]:
    """Those of the model's own list, or of the ImageNet subset that timm takes it for."""
    own = network.pretrained_cfg.get("label_names")
    if own and len(own) == network.num_classes:
        described = network.pretrained_cfg.get("label_descriptions") or {}
        return [str(described.get(label, label)) for label in own]
    subset = timm.data.infer_imagenet_subset(network)
    if not subset:
        do = "use one trained on ImageNet, or write a module:package.factory with its labels"
        raise Refused("a timm model whose labels are known", f'"{name}" with {network.num_classes} outputs', do)
    info = timm.data.ImageNetInfo(subset)
    return [info.index_to_description(index) for index in range(network.num_classes)]


@dataclass(frozen=True)
class LocalWeights:
    """Weights of a local file."""

    path: Path
    tensors: dict[str, Tensor]
    sha256: str
    card: Card | None  # input size and labels, where they are not the published ones


def _own_weights(name: str) -> tuple[str, LocalWeights | None]:
    """The model's name, and the weights of the file that is named with it."""
    name, at, file = name.partition("@") if not name.startswith("hf-hub:") else (name, "", "")  # there @ is a revision
    return name, read_weights(Path(file)) if at else None


def read_weights(path: Path) -> LocalWeights:
    """Those of a file NAME.safetensors, with the card beside it where there is one."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    if path.suffix != ".safetensors":
        do = 'save them with safetensors.torch.save_file(network.state_dict(), "NAME.safetensors")'
        raise Refused("weights in a file NAME.safetensors", f"{path}", do)
    stored = network_bytes(path)
    try:
        tensors = load(stored)
    except (SafetensorError, KeyError, ValueError, RuntimeError) as error:
        got = f"{path} that cannot be read ({error_summary(error)})"
        raise Refused("weights in safetensors", got, "save it again") from error
    card = path.with_suffix(".json")
    return LocalWeights(path, tensors, hashlib.sha256(stored).hexdigest(), read_card(card) if is_file(card) else None)


# heads that only training uses, and a counter of its steps
_UNUSED = re.compile(r"(aux\d?|AuxLogits)\..*|.*\.num_batches_tracked")


def _with(
    own: LocalWeights | None,
    network: Any,
    mean: Sequence[float],
    std: Sequence[float],
    side_px: int,
    labels: Any,
    name: str,
) -> Classifier:
    """The network as a Classifier, the file's weights in it where there is one."""
    classifier = classifier_of(Normalized(network, mean, std), side_px, labels, name)
    if own is None:
        return classifier
    do = "check the name, and write the labels of a network with others into NAME.json beside it"
    load_weights(network, own, f"{name} for {len(labels)} labels", do)
    return replace(classifier, sha256=own.sha256)


def load_weights(network: Any, own: LocalWeights, name: str, do: str) -> None:
    """The file's weights into a network of that name; refused, with what to `do`, where they are another's."""
    wanted = {key: tensor.shape for key, tensor in network.state_dict().items() if not _UNUSED.fullmatch(key)}
    given = {key: tensor.shape for key, tensor in own.tensors.items() if not _UNUSED.fullmatch(key)}
    if wrong := sorted(wanted.items() ^ given.items()):
        raise Refused(f"weights of {name}", f"{own.path} with another {wrong[0][0]}", do)
    network.load_state_dict({key: own.tensors[key] for key in wanted}, strict=False)


@contextmanager
def _offline_at_once() -> Iterator[None]:
    """Where timm's hub cannot be reached, only what was downloaded before is used; it would retry for over a minute."""
    constants: Any = importlib.import_module("huggingface_hub.constants")
    hub, before = urlsplit(constants.ENDPOINT), constants.HF_HUB_OFFLINE
    try:
        if not getproxies():  # else the way there is the proxy's to know
            socket.create_connection((hub.hostname, hub.port or 443), timeout=5).close()
    except OSError:
        constants.HF_HUB_OFFLINE = True
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = before


def downloaded(name: str, load: Callable[[], Any]) -> Any:
    """What `load` gives; refused in a sentence where it fails."""
    try:
        return load()
    except Exception as error:  # each library raises its own for no network, no weights and no space
        got = f"{type(error).__name__} ({error_summary(error)})"
        raise Refused(f"the published weights of {name}", got, "check the name and the way to the internet") from error


def library(name: str, kind: str, extra: str = "models") -> Any:
    """The library that models named `kind`:NAME need, of that extra."""
    try:
        return importlib.import_module(name)
    except Exception as error:  # a build for another torch raises RuntimeError, not ImportError
        got = f"one that cannot be imported ({error})"
        # a CPU torch with the registry's torchvision, built for CUDA: "torchvision::nms does not exist"
        do = "remove torchvision and install it from where torch is from: PyTorch's CPU index has CPU builds of both"
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            beside = "beside a CPU torch after torchvision from PyTorch's CPU index"
            got, do = "none", f'run pip install "patchproof[{extra}]", {beside}'
        raise Refused(f"the library {name} for {kind}:NAME", got, do) from error
