"""`torchvision:NAME`, `timm:NAME`, `clip:MODEL@FILE`: published networks with their published weights, or a file's.

These libraries download the weights, and only because the scene file names the model; `timm:hf-hub:ORG/NAME` is a model
of the Hugging Face hub. With `NAME@FILE.safetensors` the weights are read from the file as numbers, never as a pickle;
for a network trained with other labels, FILE.json beside it holds them and the input size. Input size, labels and
normalization are the library's own; normalization is put inside the network. A CLIP model is one that open_clip knows,
with its weights in FILE.safetensors, or MODEL/PRETRAINED with the weights published under that name; either way
FILE.json is the network's card, whose labels are prompts. Left out on purpose: the libraries' resize-then-crop, since
every network here sees the whole centered square; means over several prompts of a label; networks that write captions.

Source: Radford et al., Learning Transferable Visual Models From Natural Language Supervision, ICML 2021, section 3.1.
"""

import hashlib
import importlib
import json
import re
import socket
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit
from urllib.request import getproxies

import torch
from torch import Tensor, nn

from patchproof.base.errors import Refused
from patchproof.base.input import is_file
from patchproof.base.validation import spelling_hint
from patchproof.classifier.check import error_summary
from patchproof.classifier.custom import MAX_DETECTIONS, classifier_of, detector_of
from patchproof.classifier.detector import Detector
from patchproof.classifier.network import Classifier
from patchproof.classifier.network_file import Card, check_entries, network_bytes, read_card
from patchproof.networks.bounds import quote


class Normalized(nn.Module):
    """Wraps a network that takes (x - mean) / std as one that takes sRGB in [0, 1]."""

    def __init__(self, network: nn.Module, mean: Sequence[float], std: Sequence[float]):
        super().__init__()
        self.network = network
        self.rgb_mean = nn.Buffer(torch.tensor(mean).reshape(1, -1, 1, 1))
        self.rgb_std = nn.Buffer(torch.tensor(std).reshape(1, -1, 1, 1))

    def forward(self, photos_srgb: Tensor) -> Tensor:
        """N×3×S×S sRGB in [0, 1] → N×K logits."""
        return self.network((photos_srgb - self.rgb_mean) / self.rgb_std)


def load_torchvision(name: str) -> Classifier:
    """A torchvision classifier or detector with its default weights, or a classifier with those of a file."""
    models = import_library("torchvision", "torchvision").models
    if name in models.list_models(module=models.detection):
        return _detector(models, name)
    name, local = _split_weights(name)
    names = models.list_models(module=models)  # segmentation, detection and video have modules of their own
    if name not in names:
        do = spelling_hint(name, names, "choose one of torchvision.models.list_models()", most=3)
        raise Refused("a torchvision classifier or detector", f'"{name}"', do)
    weights = models.get_model_weights(name).DEFAULT
    view = weights.transforms()
    side_px, labels = (local and local.card and local.card[:2]) or (int(view.crop_size[0]), weights.meta["categories"])
    if local is None:
        network = download(f"torchvision:{name}", lambda: models.get_model(name, weights=weights))
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the initial weights, which the file's replace
            network = models.get_model(name, weights=None, num_classes=len(labels))
        if hasattr(network, "transform_input"):  # Inception's published weights are for another normalization
            network.transform_input = True
    return _classifier(local, Normalized(network, view.mean, view.std), side_px, labels, f"torchvision:{name}")


# arguments of torchvision's detectors with which they return all candidates, none suppressed
_UNSUPPRESSED = {"score_thresh": 1e-3, "nms_thresh": 1.0, "detections_per_img": MAX_DETECTIONS}


def _detector(models: Any, name: str) -> Detector:
    """A torchvision detector with its default weights, before suppression."""
    weights = models.get_model_weights(name).DEFAULT
    raw = {f"box_{key}": value for key, value in _UNSUPPRESSED.items()} if "rcnn" in name else _UNSUPPRESSED
    network = download(f"torchvision:{name}", lambda: models.get_model(name, weights=weights, **raw))
    view = network.transform
    input_px = view.fixed_size[0] if getattr(view, "fixed_size", None) else view.min_size[0]
    return detector_of(network, int(input_px), weights.meta["categories"], f"torchvision:{name}")


def load_timm(name: str) -> Classifier:
    """A timm model with its pretrained weights or those of a file, if its labels are known."""
    timm = import_library("timm", "timm")
    name, local = _split_weights(name)
    if not (timm.is_model(name) or (name.startswith("hf-hub:") and local is None)):
        do = spelling_hint(name, timm.list_models(), "choose one of timm.list_models()", most=3)
        raise Refused("a timm model", f'"{name}"', do)
    if local is None:
        with _offline_if_unreachable():
            network = download(f"timm:{name}", lambda: timm.create_model(name, pretrained=True))
    else:
        network = timm.create_model(name, **({"num_classes": len(local.card[1])} if local.card else {}))
    view = timm.data.resolve_model_data_config(network)
    card = local and local.card and local.card[:2]
    side_px, labels = card or (int(view["input_size"][-1]), _timm_labels(timm, network, name))
    return _classifier(local, Normalized(network, view["mean"], view["std"]), side_px, labels, f"timm:{name}")


def _timm_labels(timm: Any, network: Any, name: str) -> list[str]:
    """The labels in the model's own list, or of the ImageNet subset that timm infers."""
    own_labels = network.pretrained_cfg.get("label_names")
    if own_labels and len(own_labels) == network.num_classes:
        described = network.pretrained_cfg.get("label_descriptions") or {}
        return [str(described.get(label, label)) for label in own_labels]
    subset = timm.data.infer_imagenet_subset(network)
    if not subset:
        do = "use one trained on ImageNet, or write a module:package.factory with its labels"
        raise Refused("a timm model whose labels are known", f'"{name}" with {network.num_classes} outputs', do)
    info = timm.data.ImageNetInfo(subset)
    return [info.index_to_description(index) for index in range(network.num_classes)]


class LocalWeights(NamedTuple):
    """Weights of a local file."""

    path: Path
    tensors: dict[str, Tensor]
    sha256: str
    card: Card | None  # input size and labels, if they are not the published ones


def _split_weights(name: str) -> tuple[str, LocalWeights | None]:
    """Split NAME@FILE.safetensors into the model's name and the file's weights, None without a file."""
    model, separator, file = name.partition("@")
    is_hub = name.startswith("hf-hub:")  # there @ is followed by a revision
    return (model, read_weights(Path(file))) if separator and not is_hub else (name, None)


def read_weights(path: Path) -> LocalWeights:
    """Read NAME.safetensors and the card beside it, if there is one."""
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
    declared = json.loads(stored[8 : 8 + int.from_bytes(stored[:8], "little")]).get("__metadata__", {})
    if declared.get("format", "pt") != "pt":  # of other libraries, whose weights lie in another order
        got = f"format = {quote(declared['format'])} in {path}"
        raise Refused("weights of PyTorch", got, "convert them with the library that wrote them")
    check_entries(declared, path)
    card = path.with_suffix(".json")
    return LocalWeights(path, tensors, hashlib.sha256(stored).hexdigest(), read_card(card) if is_file(card) else None)


# heads and a step counter that only training uses
_UNUSED = re.compile(r"(aux\d?|AuxLogits)\..*|.*\.num_batches_tracked")


def _classifier(local: LocalWeights | None, network: Normalized, side_px: int, labels: Any, name: str) -> Classifier:
    """The network as a Classifier, with the file's weights if there are any."""
    classifier = classifier_of(network, side_px, labels, name)
    if local is None:
        return classifier
    do = "check the name, and write the labels of a network with others into NAME.json beside it"
    load_weights(network.network, local, f"{name} for {len(labels)} labels", do)
    return replace(classifier, sha256=local.sha256)


def _shapes(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """The shapes of weights by name; those of whole numbers say so, since quantized weights are no weights."""
    kinds = {key: "" if tensor.is_floating_point() else " of whole numbers" for key, tensor in tensors.items()}
    return {key: f"{tuple(tensors[key].shape)}{kind}" for key, kind in kinds.items() if not _UNUSED.fullmatch(key)}


def load_weights(network: Any, local: LocalWeights, name: str, advice: str) -> None:
    """Load the file's weights into a network called `name`; refused, with the `advice`, where they do not fit it."""
    network_shapes, file_shapes = map(_shapes, (network.state_dict(), local.tensors))
    if wrong := sorted(network_shapes.items() ^ file_shapes.items()):
        key = wrong[0][0]
        have, want = (shapes.get(key, "absent") for shapes in (file_shapes, network_shapes))
        raise Refused(f"weights of {name}", f"{local.path}, where {key} is {have} instead of {want}", advice)
    network.load_state_dict({key: local.tensors[key] for key in network_shapes}, strict=False)


class Prompted(nn.Module):
    """The image half of a CLIP model, with K prompts as unit vectors K×E; `scale` multiplies the cosines."""

    def __init__(self, sees: nn.Module, prompts: Tensor, scale: Tensor):
        super().__init__()
        self.sees = sees
        self.prompts = nn.Buffer(prompts.detach().clone())
        self.scale = nn.Buffer(scale.detach().clone())

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S normalized pictures → N×K logits."""
        return self.scale * nn.functional.normalize(self.sees(photos), dim=-1) @ self.prompts.T


def load_clip(name: str) -> Classifier:
    """The CLIP network `MODEL@FILE`: logits are cosines of picture and prompts, times the network's own scale."""
    open_clip = import_library("open_clip", "clip", "clip")
    model, _, file = name.rpartition("@")
    path, (architecture, _, published) = Path(file), model.partition("/")
    if not model or path.suffix not in (".safetensors", ".json"):
        expected = "prompts, as clip:MODEL@WEIGHTS.safetensors with WEIGHTS.json or clip:MODEL/PRETRAINED@PROMPTS.json"
        raise Refused(expected, f'"clip:{name}"', 'write {"input_px": 224, "labels": ["a photo of a mug", ...]} there')
    if architecture not in open_clip.list_models():
        do = spelling_hint(architecture, open_clip.list_models(), "choose one of open_clip.list_models()", most=3)
        raise Refused("a model of open_clip", f'"{architecture}"', do)
    card = read_card(path.with_suffix(".json"))
    if path.suffix == ".json":
        options = {"pretrained": published or None, "require_pretrained": True}
        network = download(f"clip:{model}", lambda: open_clip.create_model(architecture, **options))
    else:
        network = open_clip.create_model(architecture)
        load_weights(network, read_weights(path), f"clip:{architecture}", "check the model's name")
    view, size = network.visual.preprocess_cfg, network.visual.image_size
    side_px = int(size if isinstance(size, int) else min(size))
    if side_px != card.input_px:
        do = f'write "input_px": {side_px} into it'
        raise Refused(f"the input size of clip:{architecture}", f"{card.input_px} in {path.with_suffix('.json')}", do)
    with torch.no_grad():
        prompts = network.eval().encode_text(open_clip.get_tokenizer(architecture)(list(card.labels)), normalize=True)
    sees = Prompted(network.visual, prompts, network.logit_scale.exp())
    return classifier_of(Normalized(sees, view["mean"], view["std"]), side_px, card.labels, f"clip:{name}")


@contextmanager
def _offline_if_unreachable() -> Iterator[None]:
    """Use only earlier downloads where timm's hub cannot be reached; timm itself would retry for over a minute."""
    constants: Any = importlib.import_module("huggingface_hub.constants")
    hub, was_offline = urlsplit(constants.ENDPOINT), constants.HF_HUB_OFFLINE
    try:
        if not getproxies():  # a proxy resolves the host itself
            socket.create_connection((hub.hostname, hub.port or 443), timeout=5).close()
    except OSError:
        constants.HF_HUB_OFFLINE = True
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = was_offline


def download(name: str, load: Callable[[], Any]) -> Any:
    """Call `load`, which downloads published weights; refused in a sentence where it fails."""
    try:
        return load()
    except Exception as error:  # libraries raise errors of their own without network, weights or disk space
        got = f"{type(error).__name__} ({error_summary(error)})"
        raise Refused(f"the published weights of {name}", got, "check the name and the internet connection") from error


def import_library(name: str, kind: str, extra: str = "models") -> Any:
    """Import the library that models named `kind`:NAME need; `extra` is the extra of this package that installs it."""
    try:
        return importlib.import_module(name)
    except Exception as error:  # a build for another torch raises RuntimeError, not ImportError
        got = f"an import that fails ({error})"
        # a CPU torch with the registry's torchvision, built for CUDA: "torchvision::nms does not exist"
        do = "remove torchvision and install it from where torch is from: PyTorch's CPU index has CPU builds of both"
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            beside = "beside a CPU torch after torchvision from PyTorch's CPU index"
            got, do = "no such module", f'run pip install "patchproof[{extra}]", {beside}'
        raise Refused(f"the library {name} for {kind}:NAME", got, do) from error
