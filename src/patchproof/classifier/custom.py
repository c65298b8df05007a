"""`module:package.factory`: the user's own network, from the user's own code, which is imported and run.

The factory is called without arguments and returns a Classifier, or a torch.nn.Module with two attributes: `input_px`
(the side of the square it takes) and `labels` (its classes' names in the order of its outputs). The module takes
N×3×S×S sRGB in [0, 1], its normalization inside, and returns N×K logits. The import looks beside the scene file too.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from patchproof.classifier.network import Classifier, weights_sha256
from patchproof.strict import Refused


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
    return classifier_of(made, input_px, labels, name)


def classifier_of(
    network: torch.nn.Module, input_px: int, labels: Sequence[str], name: str = "python:network"
) -> Classifier:
    """A network in memory as a Classifier: it takes N×3×S×S sRGB in [0, 1], S = `input_px`, its normalization inside,
    and returns N×K logits, K the number of `labels`. Put into evaluation mode.
    """
    return Classifier(name, weights_sha256(network), input_px, tuple(map(str, labels)), network.eval())


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
