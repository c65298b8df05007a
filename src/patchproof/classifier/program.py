"""`file:NAME.pt2`, `file:NAME.onnx`: a network as a `torch.export` program or in ONNX, with NAME.json beside it.

The JSON says `input_px`, the side of the square that the program takes, and `labels`: a list, or the name of a JSON
file beside it that holds one. The program takes N×3×S×S sRGB in [0, 1], its normalization inside, and gives N×K logits;
where the JSON says `"kind": "detector"`, candidates N×A×(4+K), boxes in pixels before the logits (detector.py).
A program exported for one batch size, or for a range of them, is called in such batches.
Nothing of the file is executed: archive.py reads tensors and JSON, description.py the graph from it, and graph.py
computes its operators, which are on the list in operators.py; for ONNX these are protobuf.py, onnx_file.py and
onnx_operators.py. torch's own loader, which writes names of the file into Python, is not called, nor is onnx.

To make one: `torch.export.save(torch.export.export(network.eval(), (torch.rand(2, 3, S, S),),
dynamic_shapes=({0: torch.export.Dim("n", min=1, max=4096)},)), "NAME.pt2")`, or `torch.onnx.export` with the same
`dynamic_shapes`; what it writes into NAME.onnx.data belongs to NAME.onnx.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import torch

from patchproof.base.input import is_file, read_json
from patchproof.base.strict import Refused
from patchproof.classifier.detector import Detector
from patchproof.classifier.network import Classifier
from patchproof.networks.archive import Unwanted, read_archive
from patchproof.networks.batches import InBatches
from patchproof.networks.description import read_program
from patchproof.networks.onnx_file import read_onnx

MAX_BYTES = 4 << 30  # larger than any classifier here has been


def load_program(path: Path, device: torch.device | str = "cpu") -> Classifier:
    """The program and its card as a Classifier."""
    if path.suffix not in _WORDS:
        do = "save it with torch.export.save as NAME.pt2, or with torch.onnx.export, with NAME.json beside it"
        raise Refused("a torch.export program, file:NAME.pt2, or file:NAME.onnx", f"{path}", do)
    stored = network_bytes(path)  # once, so that what is hashed is what is loaded
    card = read_card(path.with_suffix(".json"))
    digest = hashlib.sha256(stored)
    network = _network(stored, path, digest).to(device)
    make = Detector if card.kind == Detector.KIND else Classifier
    return make(f"file:{path}", digest.hexdigest(), card.input_px, card.labels, network)


def network_bytes(path: Path) -> bytes:
    """A file of a network or of its weights, refused where there is none or it is of an absurd size."""
    if not is_file(path):
        raise Refused("a network", f"no file at {path}", "check the path")
    if path.stat().st_size > MAX_BYTES:
        raise Refused(
            f"a network of at most {MAX_BYTES >> 30} GiB", f"{path}, which is larger", "use a smaller network"
        )
    return path.read_bytes()


class Card(NamedTuple):
    """What the JSON file beside a network says."""

    input_px: int
    labels: tuple[str, ...]
    kind: str


def read_card(path: Path) -> Card:
    """The JSON file beside a network."""
    do = 'write {"input_px": 224, "labels": ["...", ...]} into it, or the name of a JSON list beside it as labels'
    card = read_json(path, "a JSON file", do, do)
    input_px, labels = (card.get("input_px"), card.get("labels")) if isinstance(card, dict) else (None, None)
    if isinstance(labels, str):
        lay = "lay the list of labels there"
        labels = read_json(path.with_name(Path(labels).name), "a JSON file", lay, lay)
    if type(input_px) is not int or not 8 <= input_px <= 4096:
        raise Refused("input_px, a whole number of pixels from 8 to 4096", f"{input_px!r} in {path}", do)
    if not isinstance(labels, list) or len(labels) < 2 or not all(isinstance(label, str) for label in labels):
        raise Refused("labels, a list of two or more names", f"other labels in {path}", do)
    kind = card.get("kind", Classifier.KIND)
    if kind not in (Classifier.KIND, Detector.KIND):
        raise Refused(f'kind, "{Classifier.KIND}" or "{Detector.KIND}"', f"{kind!r} in {path}", "write one of these")
    return Card(input_px, tuple(labels), kind)


def _network(stored: bytes, path: Path, digest: Any) -> InBatches:
    """The program as a function of any number of photographs."""

    def beside() -> bytes:
        data = network_bytes(path.with_name(f"{path.name}.data"))
        digest.update(data)
        return data

    expected, plain, again = _WORDS[path.suffix]
    try:
        if path.suffix == ".onnx":
            return InBatches(*read_onnx(stored, beside))
        return InBatches(*read_program(*read_archive(stored, path)))
    except Unwanted as error:
        raise Refused(f"{expected} of plain tensors and operators", f"{path} with {error}", plain) from error
    except Refused:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise Refused(expected, f"{path}, whose description cannot be read ({type(error).__name__})", again) from error


_EVAL = "export it in evaluation mode, without custom operators, control flow or tensor subclasses"
_WORDS = {  # what it should be, and what to do where it holds something else, or cannot be read
    ".pt2": ("a torch.export program", _EVAL, "export it again with torch.export.save, torch 2.9 or later"),
    ".onnx": ("an ONNX file", f"{_EVAL}, opset 13 or later", "export it again with torch.onnx.export"),
}
