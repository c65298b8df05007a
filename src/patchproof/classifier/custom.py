"""`module:package.factory`: the user's own network, from the user's own code, which is imported and run.

The factory is called without arguments and returns a Classifier, or a torch.nn.Module with two attributes: `input_px`
(the side of the square it takes) and `labels` (its classes' names in the order of its outputs). The module takes
N×3×S×S sRGB in [0, 1], its normalization inside, and returns N×K logits; one with `kind = "detector"` returns boxes,
as `detector_of` has it. The import looks beside the scene file too.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.classifier.detector import Detector
from patchproof.classifier.network import NOTHING, Classifier, weights_sha256

MOST_FOUND = 1000  # boxes in a picture, of networks that find any number


def load_custom(dotted: str, base: Path) -> Classifier:
    """What `package.factory()` returns, as a Classifier."""
    name, factory = f"module:{dotted}", _factory(dotted, base)
    try:
        made = factory()
    except Exception as error:  # the user's code: whatever it raises is about it
        raise Refused(f"a network from {name}", f"{type(error).__name__} ({error})", "mend the factory") from error
    if isinstance(made, Classifier):
        return made
    input_px, labels = getattr(made, "input_px", None), getattr(made, "labels", None)
    if not isinstance(made, torch.nn.Module) or not isinstance(input_px, int) or not labels or isinstance(labels, str):
        do = "return a torch.nn.Module with input_px (an int) and labels (a list of names), or a Classifier"
        raise Refused(f"a network from {name}", f"a {type(made).__name__} without them", do)
    make = detector_of if getattr(made, "kind", "") == Detector.KIND else classifier_of
    return make(made, input_px, labels, name)


def classifier_of(
    network: torch.nn.Module, input_px: int, labels: Sequence[str], name: str = "python:network"
) -> Classifier:
    """A network in memory as a Classifier: it takes N×3×S×S sRGB in [0, 1], S = `input_px`, its normalization inside,
    and returns N×K logits, K the number of `labels`. Put into evaluation mode.
    """
    return Classifier(name, weights_sha256(network), input_px, tuple(map(str, labels)), network.eval())


def detector_of(
    network: torch.nn.Module, input_px: int, labels: Sequence[str], name: str = "python:detector"
) -> Detector:
    """A detector in memory: it takes N×3×S×S sRGB in [0, 1] and returns candidates N×A×(4+K), boxes in pixels and
    logits of the K labels, or for each picture a dictionary of `boxes` M×4, `labels` M and `scores` M, as torchvision
    has them. Best before suppression and with low scores among them: only what is found can be made surer.
    """
    sha256 = weights_sha256(network)
    return Detector(name, sha256, input_px, tuple(map(str, labels)), AsCandidates(network.eval(), len(labels)))


class AsCandidates(torch.nn.Module):
    """A detector's findings as candidates, however it gives them."""

    def __init__(self, network: torch.nn.Module, labels: int):
        super().__init__()
        self.network, self.labels = network, labels

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S → N×A×(4+K)."""
        found = self.network(photos)
        if isinstance(found, Tensor):
            return found
        rows = [self._rows(each["boxes"], each["labels"], each["scores"]) for each in found]
        return torch.stack(rows)

    def _rows(self, boxes: Tensor, labels: Tensor, scores: Tensor) -> Tensor:
        """`MOST_FOUND`×(4+K), the surest first; what is left over lies nowhere and shows nothing."""
        surest = scores.argsort(descending=True)[:MOST_FOUND]
        nothing = scores.new_full((MOST_FOUND, self.labels), NOTHING)
        logits = torch.logit(scores[surest].clamp(1e-6, 1 - 1e-6))
        rows = torch.arange(len(surest), device=scores.device)
        nothing = nothing.index_put((rows, labels[surest]), logits)
        return torch.cat([torch.nn.functional.pad(boxes[surest], (0, 0, 0, MOST_FOUND - len(surest))), nothing], 1)


def _factory(dotted: str, base: Path):
    module_name, _, attribute = dotted.rpartition(".")
    if not module_name or not all(part.isidentifier() for part in dotted.split(".")):
        raise Refused("module:package.factory", f'"module:{dotted}"', "name a module and a function in it")
    sys.path.append(str(base.resolve()))  # last, so that nothing beside the scene shadows an installed package
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # SyntaxError and the like in the user's module too
        do = "install it, or lay it beside the scene file"
        raise Refused(f"the module {module_name} of module:{dotted}", f"an import that fails ({error})", do) from error
    finally:
        sys.path.pop()
    if not callable(factory := getattr(module, attribute, None)):
        raise Refused(f"a function {attribute} in {module_name}", "none", "check the name after the last dot")
    return factory
