"""`file:NAME.onnx`: a network as an ONNX file, with NAME.json beside it.

The JSON holds `input_px`, the side of the square that the network takes, and `labels`: a list, or the name of a JSON
file beside it that holds one. The network takes N×3×S×S sRGB in [0, 1], its normalization inside, and gives N×K logits;
with `"kind": "detector"` in the JSON, candidates N×A×(4+K), boxes in pixels before the logits (detector.py). A network
that was exported for a fixed number of pictures is called with that number.
Nothing of the file is executed: protobuf.py reads its fields, onnx_file.py the graph from them, and graph.py computes
its operators, which are on the list in onnx_operators.py. The library onnx is not called.

`EXPORT_ADVICE` says how to make such a file. Data that an exporter writes into NAME.onnx.data belong to NAME.onnx.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

from patchproof.base.errors import Refused
from patchproof.base.input import read_file, read_json
from patchproof.classifier.detector import Detector
from patchproof.classifier.network import Classifier
from patchproof.networks.batches import BatchedNetwork
from patchproof.networks.bounds import UnsupportedNetwork
from patchproof.networks.onnx_file import read_onnx

MAX_BYTES = 4 << 30  # larger than any classifier tested
EXPORT_ADVICE = (
    'export it with torch.onnx.export(network.eval(), (torch.rand(2, 3, S, S),), "NAME.onnx", '
    'dynamic_shapes=({0: torch.export.Dim("n")},), dynamo=True), S pixels a side, and put NAME.json beside it'
)


def load_network(path: Path) -> Classifier:
    """The ONNX file and its card as a Classifier; other kinds of files are refused by their suffix."""
    if path.suffix != ".onnx":
        raise Refused("a network as an ONNX file, file:NAME.onnx", f"{path}", EXPORT_ADVICE)
    stored = network_bytes(path)  # read once, so that the hash is of the bytes that are loaded
    card = read_card(path.with_suffix(".json"))
    digest = hashlib.sha256(stored)

    def read_data() -> bytes:
        data = network_bytes(path.with_name(f"{path.name}.data"))
        digest.update(data)
        return data

    try:
        network = BatchedNetwork(*read_onnx(stored, read_data))
    except UnsupportedNetwork as error:
        do = "export it in evaluation mode, without custom operators and control flow, opset 13 or later"
        raise Refused("an ONNX file of plain tensors and operators", f"{path} with {error}", do) from error
    except Refused:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        got = f"{path}, whose description cannot be read ({type(error).__name__})"
        raise Refused("an ONNX file", got, "export it again with torch.onnx.export") from error
    make = Detector if card.kind == Detector.KIND else Classifier
    return make(f"file:{path}", digest.hexdigest(), card.input_px, card.labels, network)


def network_bytes(path: Path) -> bytes:
    """Read a file of a network or its weights; refused if it is missing or larger than `MAX_BYTES`."""
    return read_file(path, "a network", max_bytes=MAX_BYTES)


class Card(NamedTuple):
    """The contents of the JSON file beside a network."""

    input_px: int
    labels: tuple[str, ...]
    kind: str


def read_card(path: Path) -> Card:
    """Read the JSON file beside a network."""
    do = 'write {"input_px": 224, "labels": ["...", ...]} into it, or the name of a JSON list beside it as labels'
    card = read_json(path, "a JSON file", do, do)
    input_px, labels = (card.get("input_px"), card.get("labels")) if isinstance(card, dict) else (None, None)
    if isinstance(labels, str):
        advice = "put the list of labels there"
        labels = read_json(path.with_name(Path(labels).name), "a JSON file", advice, advice)
    if type(input_px) is not int or not 8 <= input_px <= 4096:
        raise Refused("input_px, a whole number of pixels from 8 to 4096", f"{input_px!r} in {path}", do)
    if not isinstance(labels, list) or len(labels) < 2 or not all(isinstance(label, str) for label in labels):
        raise Refused("labels, a list of two or more names", f"{str(labels)[:60]} in {path}", do)
    kind = card.get("kind", Classifier.KIND)
    if kind not in (Classifier.KIND, Detector.KIND):
        raise Refused(f'kind, "{Classifier.KIND}" or "{Detector.KIND}"', f"{kind!r} in {path}", "write one of these")
    return Card(input_px, tuple(labels), kind)
