"""`module:package.factory`: the user's own network, from the user's own code, which is imported and run.

The factory is called without arguments and returns a Classifier, or a torch.nn.Module with two attributes: `input_px`
(the side of the square it takes) and `labels` (its classes' names in the order of its outputs). The module takes
N×3×S×S sRGB in [0, 1], its normalization inside, and returns N×K logits; one with `kind = "detector"` returns boxes as
`detector_of` describes them. Modules beside the scene file are found, too.
"""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import keystr, tree_flatten_with_path

from patchproof.base.errors import Refused
from patchproof.classifier.detector import Detector
from patchproof.classifier.head_decoder import HeadDecoder, spread_labels
from patchproof.classifier.heads import head_of
from patchproof.classifier.network import INPUT_PX, NO_BOX_LOGIT, Classifier, weights_sha256

MAX_DETECTIONS = 1000  # boxes in a picture, for networks that find any number of them


def load_custom(dotted: str, base: Path) -> Classifier:
    """Call `package.factory()` and return the result as a Classifier."""
    name, factory = f"module:{dotted}", _factory(dotted, base)
    try:
        network = factory()
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        raise Refused(f"a network from {name}", f"{type(error).__name__} ({error})", "fix the factory") from error
    return network if isinstance(network, Classifier) else labeled_module(network, name)


def labeled_module(module: object, name: str) -> Classifier:
    """The Classifier of a torch module that has its `input_px` and `labels` as attributes; anything else is refused."""
    input_px, labels = getattr(module, "input_px", None), getattr(module, "labels", None)
    if not isinstance(module, torch.nn.Module) or input_px is None or labels is None:
        do = "give it input_px (an int) and labels (a list of names), or wrap it with classifier_of"
        got = f"an object of type {type(module).__name__}"
        raise Refused(f"a torch.nn.Module with input_px and labels as {name}", got, do)
    if getattr(module, "kind", "") == Detector.KIND:
        return detector_of(module, input_px, labels, name, getattr(module, "head", None))
    return classifier_of(module, input_px, labels, name)


def classifier_of(
    network: Callable[[Tensor], Tensor], input_px: int, labels: Sequence[str], name: str = "python:network"
) -> Classifier:
    """Make a Classifier of a network in memory.

    Args:
        network: takes N×3×S×S sRGB in [0, 1], its normalization inside, and returns N×K logits. A torch module is put
            into evaluation mode; scripted modules, `ExportedProgram.module()` and plain functions are taken as they
            are.
        input_px: S, the side of the square that it takes, in pixels.
        labels: names of its K classes, in the order of its outputs.
        name: what runs and reports call it, "python:" and a word.

    Raises:
        Refused: for what cannot be called with a batch of pictures.
    """
    labels = _checked_labels(network, input_px, labels, name, 2)
    return Classifier(name, weights_sha256(network), input_px, labels, _in_evaluation_mode(network))


def detector_of(
    network: Callable[..., Any], input_px: int, labels: Sequence[str], name: str = "python:detector", head: Any = None
) -> Detector:
    """A detector in memory: it takes N×3×S×S sRGB in [0, 1] and returns candidates N×A×(4+K), boxes in pixels and
    logits of the K labels; what a `head` of `heads.HEADS` gives, as a tensor, a list or a dictionary; or for each
    picture a dictionary of `boxes` M×4, `labels` M and `scores` M, as torchvision has them. Best before suppression and
    with low scores among them: only what is found can be made surer.
    """
    labels = _checked_labels(network, input_px, labels, name, 1)
    decoder = HeadDecoder(name, len(labels), input_px, head_of(head, name) if isinstance(head, str | dict) else None)
    candidates = AsCandidates(_in_evaluation_mode(network), decoder)
    return Detector(name, weights_sha256(network), input_px, labels, candidates)


def _checked_labels(network: object, input_px: object, labels: Any, name: str, least: int) -> tuple[str, ...]:
    """Labels in order, `least` at least; refused is what cannot be called: an ExportedProgram, a list of weights."""
    if callable(network) and not isinstance(network, type | torch.export.ExportedProgram):
        if type(input_px) is not int or input_px not in INPUT_PX:
            raise Refused("input_px, a whole number from 8 to 4096", f"{input_px!r} in {name}", "give its side in px")
        names = () if isinstance(labels, str | Mapping | Set) else tuple(map(str, labels))
        if len(names) < least:
            expected = f"labels, a list of {least} or more names"
            raise Refused(expected, f"{str(labels)[:60]} in {name}", "list them in the order of its outputs")
        return names
    exported = isinstance(network, torch.export.ExportedProgram)
    do = "call its .module() first" if exported else "give the module itself, or load a file with load_classifier"
    got = "an ExportedProgram" if exported else f"an object of type {type(network).__name__}"
    raise Refused("a network that can be called with a batch of pictures", got, do)


def _in_evaluation_mode(network: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """The network in evaluation mode; exported modules have no modes, nor have functions."""
    if isinstance(network, torch.nn.Module):
        with suppress(NotImplementedError):  # ExportedProgram.module() keeps the mode of its export
            network.eval()
    return network


class AsCandidates(torch.nn.Module):
    """Turns a detector's outputs of any kind into candidates N×A×(4+K)."""

    def __init__(self, network: Callable[[Tensor], Any], decoder: HeadDecoder):
        super().__init__()
        self.network, self.decoder = network, decoder

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S → N×A×(4+K)."""
        output = self.network(photos)
        if isinstance(output, list) and len(output) == len(photos) and isinstance(output[0], dict):
            return torch.stack([self._rows(each["boxes"], each["labels"], each["scores"]) for each in output])
        named, _ = tree_flatten_with_path(output)
        return self.decoder([keystr(path) for path, _ in named], *(value for _, value in named))

    def _rows(self, boxes: Tensor, labels: Tensor, scores: Tensor) -> Tensor:
        """`MAX_DETECTIONS`×(4+K) of one picture, the surest first; unused rows have an empty box and no score."""
        surest = scores.argsort(descending=True)[:MAX_DETECTIONS]
        rows = spread_labels(boxes[surest], labels[surest], scores[surest], self.decoder.labels)
        unused = MAX_DETECTIONS - len(surest)
        return torch.cat([rows, rows.new_tensor([[0.0] * 4 + [NO_BOX_LOGIT] * self.decoder.labels]).expand(unused, -1)])


def _factory(dotted: str, base: Path):
    module_name, _, attribute = dotted.rpartition(".")
    if not module_name or not all(part.isidentifier() for part in dotted.split(".")):
        raise Refused("module:package.factory", f'"module:{dotted}"', "name a module and a function in it")
    sys.path.append(str(base.resolve()))  # last, so that nothing beside the scene shadows an installed package
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # SyntaxError and the like in the user's module too
        is_missing = isinstance(error, ModuleNotFoundError)
        do = "install it, or put it beside the scene file" if is_missing else "correct its code"
        raise Refused(f"the module {module_name} of module:{dotted}", f"an import that fails ({error})", do) from error
    finally:
        sys.path.pop()
    if not callable(factory := getattr(module, attribute, None)):
        raise Refused(f"a function {attribute} in {module_name}", "none", "check the name after the last dot")
    return factory
