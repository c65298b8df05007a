"""`torchvision:NAME` and `timm:NAME`: published networks with their published weights.

The weights are downloaded by these libraries, and only because the scene file names the model. The libraries are not
needed otherwise: where one is missing, the sentence says what to install. Input size, labels and the mean and standard
deviation that the weights were trained with are the library's own figures; normalization is put inside the network.
Their resize-then-crop is left out on purpose: here every network sees the whole centered square.
"""

from __future__ import annotations

import importlib
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies

import torch
from torch import Tensor, nn

from patchproof.classifier.check import first_line
from patchproof.classifier.custom import MOST_FOUND, classifier_of, detector_of
from patchproof.classifier.detector import Detector
from patchproof.classifier.labels import nearest_names
from patchproof.classifier.network import Classifier
from patchproof.strict import Refused


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
    """A torchvision classification or detection model with its default weights."""
    models = _library("torchvision").models
    if name in models.list_models(module=models.detection):
        return _detector(models, name)
    known = models.list_models(module=models)  # segmentation, detection and video have modules of their own
    if name not in known:
        do = nearest_names(name, known, "choose one of torchvision.models.list_models()")
        raise Refused("a torchvision classifier or detector", f'"{name}"', do)
    weights = models.get_model_weights(name).DEFAULT
    network = _downloaded(f"torchvision:{name}", lambda: models.get_model(name, weights=weights))
    view = weights.transforms()
    normalized = Normalized(network, view.mean, view.std)
    return classifier_of(normalized, int(view.crop_size[0]), weights.meta["categories"], f"torchvision:{name}")


# of torchvision's detectors by what their constructors call it: as many candidates as there are, none suppressed
_RAW = {"score_thresh": 1e-3, "nms_thresh": 1.0, "detections_per_img": MOST_FOUND}


def _detector(models: Any, name: str) -> Detector:
    """A torchvision detector with its default weights, before suppression."""
    weights = models.get_model_weights(name).DEFAULT
    raw = {f"box_{key}": value for key, value in _RAW.items()} if "rcnn" in name else _RAW
    network = _downloaded(f"torchvision:{name}", lambda: models.get_model(name, weights=weights, **raw))
    view = network.transform
    input_px = view.fixed_size[0] if getattr(view, "fixed_size", None) else view.min_size[0]
    return detector_of(network, int(input_px), weights.meta["categories"], f"torchvision:{name}")


def load_timm(name: str) -> Classifier:
    """A timm model with its pretrained weights, for the ImageNet subsets that timm has the labels of."""
    timm = _library("timm")
    if not timm.is_model(name):
        do = nearest_names(name, timm.list_models(), "choose one of timm.list_models()")
        raise Refused("a timm model", f'"{name}"', do)
    with _offline_at_once():
        network = _downloaded(f"timm:{name}", lambda: timm.create_model(name, pretrained=True))
    subset = timm.data.infer_imagenet_subset(network)
    if not subset:
        do = "use one trained on ImageNet, or write a module:package.factory with its labels"
        raise Refused("a timm model whose labels are known", f'"{name}" with {network.num_classes} outputs', do)
    info, view = timm.data.ImageNetInfo(subset), timm.data.resolve_model_data_config(network)
    labels = [info.index_to_description(index) for index in range(network.num_classes)]
    normalized = Normalized(network, view["mean"], view["std"])
    return classifier_of(normalized, int(view["input_size"][-1]), labels, f"timm:{name}")


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


def _downloaded(name: str, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except Exception as error:  # each library raises its own for no network, no weights and no space
        got = f"{type(error).__name__} ({first_line(error)})"
        raise Refused(f"the published weights of {name}", got, "check the name and the way to the internet") from error


def _library(name: str):
    try:
        return importlib.import_module(name)
    except Exception as error:  # a build for another torch raises RuntimeError, not ImportError
        missing = isinstance(error, ModuleNotFoundError) and error.name == name
        got = "none" if missing else f"one that cannot be imported ({error})"
        # a CPU torch with the registry's torchvision, built for CUDA: "torchvision::nms does not exist"
        do = "remove torchvision and install it from where torch is from: PyTorch's CPU index has CPU builds of both"
        if missing:
            do = 'run pip install "patchproof[models]", beside a CPU torch after torchvision from PyTorch\'s CPU index'
        raise Refused(f"the library {name} for {name}:NAME", got, do) from error
